// The glossary: a dialog of viser, to which the page adds a search box and a button that stay in sight. Escape and the browser's Back
// close it, too. In plain words it begins with the words of the plain screens, and all others are folded.
(() => {
  const lpn = window.lpn;
  if (lpn.glossary) return;
  const { SELECTORS } = lpn.viser;
  let opener = null, content = null;
  const FIRST = "First words"; // the heading of the plain screens' words
  let all = false; // all terms have been unfolded
  let stepped = false; // the browser's history has the open glossary as a step of its own
  const viserClose = () => content?.querySelector(SELECTORS.dialogButton);
  const plain = (text) => text.toLowerCase().replaceAll("²", "2");

  const headingOf = (table) => {
    let heading = table.previousElementSibling || table.parentElement.previousElementSibling;
    while (heading && !heading.matches("h1, h2, h3")) heading = heading.previousElementSibling;
    return heading;
  };

  const search = (box, found, more) => {
    const words = plain(box.value).split(/\s+/).filter(Boolean), tables = [...content.querySelectorAll("table")];
    const folded = !all && !words.length && headingOf(tables[0])?.textContent === FIRST;
    let count = 0;
    for (const table of tables) {
      let left = 0;
      for (const row of table.querySelectorAll("tbody tr")) {
        const text = plain(row.textContent), fits = folded ? table === tables[0] : words.every((word) => text.includes(word));
        row.hidden = !fits;
        left += fits;
      }
      count += left;
      table.hidden = !left;
      const heading = headingOf(table);
      if (heading) heading.hidden = !left;
    }
    for (const text of content.querySelectorAll("p")) text.hidden = folded;
    more.hidden = !folded;
    more.textContent = "All " + content.querySelectorAll("tbody tr").length + " terms";
    found.textContent = count ? count + (count === 1 ? " term" : " terms") : "No term matches.";
  };

  const build = () => {
    const bar = document.createElement("div");
    bar.id = "lpn-glossary";
    bar.className = "lpn";
    bar.innerHTML = '<label>Search <input type="search" maxlength="80"></label><span role="status" class="dim"></span><button type="button">Close</button>';
    const [box, found, close] = [bar.querySelector("input"), bar.querySelector("[role=status]"), bar.querySelector("button")];
    const more = document.createElement("button");
    more.id = "lpn-glossary-all";
    more.type = "button";
    const rest = matchMedia("(pointer: coarse)").matches ? close : box; // a keyboard on the screen would cover the terms
    const look = () => search(box, found, more);
    all = false;
    more.onclick = () => {
      all = true;
      look();
      rest.focus({ preventScroll: true });
    };
    box.oninput = look;
    bar.onkeydown = (event) => event.key !== "Escape" && event.key !== "Tab" && event.stopPropagation(); // letters are no commands here
    close.onclick = () => viserClose()?.click();
    content.querySelector(SELECTORS.dialogHeader).append(bar);
    content.querySelector(SELECTORS.dialogBody).append(more);
    content.classList.add("lpn-glossary");
    look();
    rest.focus();
  };

  lpn.glossary = { open: () => content !== null };
  // The browser's Back was pressed: whether it closes the glossary.
  lpn.backClosesGlossary = () => {
    if (!content) return false;
    stepped = false;
    viserClose()?.click();
    return true;
  };

  const follow = () => {
    const shown = [...document.querySelectorAll(SELECTORS.dialog)].find(
      (one) => one.querySelector(SELECTORS.dialogTitle)?.textContent === "Glossary" && one.querySelector("table"),
    );
    if (shown && shown !== content) {
      content = shown;
      opener = lpn.lastFocus();
      build();
      history.pushState(history.state, "", location.href);
      stepped = true;
    } else if (!shown && content) {
      content = null;
      if (stepped) lpn.backQuietly();
      stepped = false;
      lpn.refocus(opener);
    }
  };
  new MutationObserver(follow).observe(document.body, { childList: true, subtree: true });
  window.addEventListener(
    "keydown",
    (event) => {
      if (event.key !== "Escape" || !content) return;
      event.stopImmediatePropagation();
      viserClose()?.click();
    },
    true,
  );
})();
