// All that the page's scripts know of viser's page: its class names, attributes, globals, and words, those of viser 1.1.1.
// `tests/e2e/test_viser_page.py` names each, and fails when viser changes it.
(() => {
  if (window.lpn) return;
  const lpn = (window.lpn = /** @type {Lpn} */ ({}));

  // By what they select.
  const SELECTORS = {
    app: "#root", // all that viser draws
    canvas: "canvas[data-engine]",
    stageFrame: 'div[style*="flex-grow: 1"]', // around the canvas
    shade: 'div[style*="transition: opacity 150ms"]', // shades the panels while the connection is lost
    window: ".mantine-Paper-root", // a window or a folder, and its head
    folderHead: '.mantine-Paper-root > .mantine-Paper-root[style*="cursor: pointer"]',
    unfolded: ".tabler-icon-chevron-up",
    sheet: '.mantine-Paper-root[style*="max-height: 60%"]', // the panels of a phone
    sheetHead: '.mantine-Paper-root[style*="max-height: 60%"] div[style="width: 20em;"] > div[style*="cursor: pointer"]',
    sheetParts: "div:has(> .mantine-Divider-root)", // around the panels and the windows of a phone, one below the other
    scrollRoot: ".mantine-ScrollArea-root",
    scrolled: ".mantine-ScrollArea-viewport",
    dialog: ".mantine-Modal-content",
    dialogTitle: ".mantine-Modal-title",
    dialogHeader: ".mantine-Modal-header",
    dialogBody: ".mantine-Modal-body",
    dialogButton: ".mantine-Modal-body button",
    palette: ".mantine-Spotlight-content",
    notification: ".mantine-Notification-root",
    notificationText: ".mantine-Notification-description",
    softwareNotice: "#webgl-software-rendering",
    upload: 'input[type="file"]',
    tab: '[role="tab"]',
    left: '[data-dock-region="left"]', // the panel of the query, open or folded
    leftOpen: '[data-dock-region-collapse="left"]', // what folds it
  };
  // Icons that are the only content of a button, and what such a button does.
  const ICONS = [
    [".mantine-CloseButton-root, .tabler-icon-x", "Close"],
    [".tabler-icon-list-search, .tabler-icon-search", "Every command"],
    [".tabler-icon-adjustments, .tabler-icon-settings", "Settings of the connection and the stage"],
    [".tabler-icon-arrow-back", "Back"],
  ];
  // viser's words: what it says when an upload is sent, and what names the button of a folded panel before the panel's name.
  const UPLOADED = "File uploaded successfully.", EXPAND = "Expand panel ";
  // The height of what a folded sheet holds.
  const FOLDED = "0px";
  const SCHEME = "data-mantine-color-scheme";
  const NAMELESS = `${SELECTORS.app} :is([role="slider"], input:not([type="hidden"])):is(:not([aria-label]), [aria-label=""])`;

  // The row of a control holds its label and its element.
  const rowWith = (element, selector) => {
    let row = element;
    while (row && !row.querySelector(selector)) row = row.parentElement;
    return row;
  };

  // viser opens its folders by clicks only, gives its sliders, boxes, and icons no names, and says that an upload has succeeded when it
  // is sent, before it is read.
  const mend = () => {
    for (const head of document.querySelectorAll(SELECTORS.folderHead)) {
      head.tabIndex = 0;
      head.setAttribute("role", "button");
      head.setAttribute("aria-expanded", String(!!head.querySelector(SELECTORS.unfolded)));
      head.dataset.lpnFolder = "";
    }
    for (const control of document.querySelectorAll(NAMELESS)) {
      if (control.closest("label")) continue; // it is named by the label around it
      const row = rowWith(control.parentElement, "label");
      if (row) control.setAttribute("aria-label", row.querySelector("label").textContent || "value");
    }
    for (const button of document.querySelectorAll("button:not([aria-label])"))
      if (!button.textContent.trim()) button.setAttribute("aria-label", ICONS.find(([icon]) => button.matches(icon) || button.querySelector(icon))?.[1] || "Button");
    for (const text of document.querySelectorAll(SELECTORS.notificationText)) if (text.textContent === UPLOADED) text.textContent = "Sent; it is being read.";
  };

  // viser opens a websocket every second while the connection is lost, in place of the one before. Each of its tries passes to `tries`
  // with a function that goes on with it. templates/connection.js, which runs before viser, has rewritten the address of each.
  const onRetry = (tries) => {
    const post = Worker.prototype.postMessage;
    Worker.prototype.postMessage = function (message, ...rest) {
      if (message?.type === "retry") tries(() => post.call(this, message, ...rest));
      else post.call(this, message, ...rest);
    };
  };

  lpn.viser = {
    SELECTORS,
    UPLOADED,
    EXPAND,
    FOLDED,
    SCHEME,
    mend,
    onRetry,
    // The element of a control in the row of its label; null while viser has removed it, as it does in a folded panel.
    field: (uuid) => rowWith(document.querySelector(`label[for="${uuid}"]`), "input")?.querySelector("input") ?? null,
    // three.js's camera and viser's controls of it.
    camera: () => window.__viserMutable?.camera,
    cameraControls: () => window.__viserMutable?.cameraControl,
    sendCamera: () => window.__viserMutable?.sendCamera?.(),
    // Have viser draw the stage's next frames.
    draw: () => window.__viserMutable?.requestRender?.(),
    // The quaternion (w, x, y, z) from the server's axes to those of the page; nothing before viser has it.
    axes: () => window.__viserSceneTree?.getState()[""]?.wxyz,
    // True if viser shades its panels; null while they are not in the page.
    shaded: () => {
      const shade = document.querySelector("#lpn-header, #lpn-status")?.closest(SELECTORS.shade);
      return shade ? parseFloat(shade.style.opacity) < 1 : null;
    },
  };
  // Look so many milliseconds after the page's elements or their styles have changed, and now. Return a function that ends it.
  lpn.onChange = (period, look) => {
    let waiting = 0;
    const soon = () => {
      waiting ||= setTimeout(() => {
        waiting = 0;
        look();
      }, period);
    };
    const changes = new MutationObserver(soon);
    changes.observe(document.body, { childList: true, subtree: true, attributeFilter: ["style"] });
    soon();
    return () => {
      changes.disconnect();
      clearTimeout(waiting);
      waiting = Infinity;
    };
  };
  // Look every so many milliseconds at what changes without an event, as the camera does. Return what `clearInterval` ends.
  lpn.every = (period, look) => setInterval(look, period);
})();
