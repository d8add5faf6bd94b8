// The glossary: a dialog of viser, to which the page adds a search box and a button that stay in sight. Escape and the browser's Back
// close it, too.
(() => {
  const lpn = window.lpn;
  if (lpn.glossary) return;
  const { SELECTORS } = lpn.viser;
  let opener = null, content = null;
  let stepped = false; // the browser's history has the open glossary as a step of its own
  const viserClose = () => content?.querySelector(SELECTORS.dialogButton);
  const plain = (text) => text.toLowerCase().replaceAll("²", "2");

  const search = (box, found) => {
    const words = plain(box.value).split(/\s+/).filter(Boolean);
    let count = 0;
    for (const table of content.querySelectorAll("table")) {
      let left = 0;
      for (const row of table.querySelectorAll("tbody tr")) {
        const text = plain(row.textContent), fits = words.every((word) => text.includes(word));
        row.hidden = !fits;
        left += fits;
      }
      count += left;
      table.hidden = !left;
      let heading = table.previousElementSibling || table.parentElement.previousElementSibling;
      while (heading && !heading.matches("h1, h2, h3")) heading = heading.previousElementSibling;
      if (heading) heading.hidden = !left;
    }
    found.textContent = count ? count + (count === 1 ? " term" : " terms") : "No term matches.";
  };

  const build = () => {
    const bar = document.createElement("div");
    bar.id = "lpn-glossary";
    bar.className = "lpn";
    bar.innerHTML = '<label>Search <input type="search" maxlength="80"></label><span role="status" class="dim"></span><button type="button">Close</button>';
    const [box, found, close] = [bar.querySelector("input"), bar.querySelector("[role=status]"), bar.querySelector("button")];
    box.oninput = () => search(box, found);
    bar.onkeydown = (event) => event.key !== "Escape" && event.key !== "Tab" && event.stopPropagation(); // letters are no commands here
    close.onclick = () => viserClose()?.click();
    content.querySelector(SELECTORS.dialogHeader).append(bar);
    content.classList.add("lpn-glossary");
    search(box, found);
    (matchMedia("(pointer: coarse)").matches ? close : box).focus(); // a keyboard on the screen would cover the terms
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
