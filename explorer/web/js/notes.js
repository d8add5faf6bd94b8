// The boxes for a query's tags and note. What is typed stays in the browser until the server has saved it: another query, a full
// disk, a lost connection, or loading the page again loses nothing.
(() => {
  const lpn = window.lpn;
  if (lpn.note) return;
  // The notes that this page has saved since the server filled the boxes; viser may put the same boxes into the page again.
  const saved = new Map();

  const key = (path) => "lpn-note " + lpn.title + " " + path;
  const boxesOf = (row) => [...row.querySelectorAll("input, textarea")];
  const shown = (path) => [...document.querySelectorAll(".lab-note")].find((row) => row.dataset.path === path);
  const same = (one, other) => JSON.stringify(one) === JSON.stringify(other);

  // A draft: the texts that are typed, and those that the server had before.
  const drafts = new Map(); // for a browser that denies its storage
  const draft = (path) => {
    try {
      return JSON.parse(lpn.stored("session", key(path)) ?? "null") || drafts.get(path) || null;
    } catch {
      return null; // another program's text
    }
  };
  const keep = (path, typed, before) => {
    const changed = typed !== null && !same(typed, before);
    if (changed) drafts.set(path, { typed: typed, before: before });
    else drafts.delete(path);
    lpn.store("session", key(path), changed ? JSON.stringify(drafts.get(path)) : null);
    shown(path)?.classList.toggle("unsaved", changed);
  };

  lpn.noteTyped = (box) => {
    const row = box.closest(".lab-note"), boxes = boxesOf(row);
    keep(row.dataset.path, boxes.map((one) => one.value), draft(row.dataset.path)?.before || boxes.map((one) => one.defaultValue));
  };

  lpn.note = (element) => {
    const row = element.closest(".lab-note"), boxes = boxesOf(row);
    const before = draft(row.dataset.path)?.before || boxes.map((one) => one.defaultValue);
    lpn.send("lab-note", [row.dataset.task, Number(row.dataset.row), ...boxes.map((one) => one.value), before]);
  };

  // The boxes are in the page, filled by the server.
  lpn.noteOpened = (path) => {
    const row = shown(path), last = saved.get(path), kept = draft(path);
    if (!row) return;
    const stored = last?.opened === row.dataset.opened ? last.texts : boxesOf(row).map((one) => one.defaultValue);
    boxesOf(row).forEach((one, i) => {
      one.defaultValue = stored[i];
      one.value = kept ? kept.typed[i] : stored[i];
    });
    row.classList.toggle("unsaved", kept !== null);
  };

  // The server has these texts now, be they this page's or, after a refused save, somebody else's.
  lpn.noteStored = (path, texts) => {
    const row = shown(path), kept = draft(path);
    if (row) {
      saved.set(path, { opened: row.dataset.opened, texts: texts });
      boxesOf(row).forEach((one, i) => {
        const typed = one.value;
        one.defaultValue = texts[i];
        one.value = typed;
      });
    }
    keep(path, row ? boxesOf(row).map((one) => one.value) : kept && kept.typed, texts);
  };
})();
