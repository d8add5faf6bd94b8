// A picture that a press shows as large as the window allows, with its caption. Another press, Escape, and the browser's Back close it.
(() => {
  const lpn = window.lpn;
  if (lpn.enlargeable) return;
  /** @type {HTMLDialogElement | null} */
  let openDialog = null;
  let stepped = false; // the browser's history has the open picture as a step of its own

  const open = (picture) => {
    const dialog = document.body.appendChild(document.createElement("dialog"));
    const figure = dialog.appendChild(picture.closest("figure").cloneNode(true)), large = figure.querySelector("img");
    figure.querySelectorAll("a, .steps").forEach((one) => one.remove());
    for (const name of ["role", "tabindex", "title", "data-large"]) large.removeAttribute(name);
    dialog.id = "lpn-large";
    dialog.classList.toggle("north-up", picture.closest(".north-up") !== null);
    dialog.setAttribute("aria-label", picture.alt);
    dialog.style.setProperty("--ratio", String(picture.naturalWidth / picture.naturalHeight));
    const close = dialog.appendChild(document.createElement("button"));
    close.type = "button";
    close.textContent = "Close";
    dialog.onclick = () => dialog.close();
    dialog.onclose = () => {
      dialog.remove();
      openDialog = null;
      if (stepped) lpn.backQuietly();
      stepped = false;
      // The page may have been drawn anew meanwhile.
      const again = [...document.querySelectorAll("[data-large]")].find((one) => /** @type {HTMLImageElement} */ (one).alt === picture.alt);
      lpn.refocus(picture.isConnected ? picture : again);
    };
    dialog.showModal();
    openDialog = dialog;
    history.pushState(history.state, "", location.href);
    stepped = true;
  };

  lpn.enlargeable = (picture) => {
    picture.tabIndex = 0;
    picture.setAttribute("role", "button");
    picture.title = "Show it large";
    picture.dataset.large = "";
    picture.onclick = () => open(picture);
  };
  // The browser's Back was pressed: whether it closes the picture.
  lpn.backClosesPicture = () => {
    if (!openDialog) return false;
    stepped = false;
    openDialog.close();
    return true;
  };
  // No key is a command of the page meanwhile.
  window.addEventListener("keydown", (event) => openDialog && event.stopImmediatePropagation(), true);
})();
