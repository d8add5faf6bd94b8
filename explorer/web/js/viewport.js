// The page around the panels: styles, notices, the size of the stage, and keyboard events.
(() => {
  const lpn = window.lpn;
  if (lpn.head) return;

  const element = (id, parent) => {
    const node = document.getElementById(id) || parent.appendChild(document.createElement("div"));
    node.id = id;
    return node;
  };

  // Styles live outside the panels, because viser removes the content of a folded panel.
  lpn.head = (html) => {
    const holder = element("lpn-head", document.body);
    holder.hidden = true;
    if (holder.innerHTML !== html) holder.innerHTML = html;
  };

  lpn.say = (text, seconds = 4) => {
    const notice = element("lpn-notice", document.body);
    notice.setAttribute("role", "status");
    notice.textContent = text;
    notice.classList.add("shown");
    clearTimeout(notice.hiding);
    if (seconds) notice.hiding = setTimeout(() => notice.classList.remove("shown"), 1000 * seconds);
  };

  // viser shades the panels while the connection is lost, and reconnects by itself.
  let lost = false;
  setInterval(() => {
    const shade = document.getElementById("lpn-header")?.closest('div[style*="transition: opacity 150ms"]');
    const now = !!shade && parseFloat(shade.style.opacity) < 1;
    if (now && !lost) lpn.say("The server does not answer. Start it again: the page goes on with what you see.", 0);
    if (lost && shade && !now) lpn.say("The server answers again.");
    if (shade) lost = now;
  }, 1000);

  lpn.upload = () => document.querySelector('input[type="file"]')?.click();

  // The closing command palette restores the focus; set it afterwards.
  lpn.focus = (uuid) =>
    setTimeout(() => (lpn.field(uuid) ? lpn.field(uuid).focus() : lpn.say("Unfold the panel Query first.")), 400);

  // viser would move the camera by these keys, which are the app's shortcuts.
  document.documentElement.addEventListener("keydown", (event) => {
    if (/^Key[WASDQE]$/.test(event.code)) event.stopPropagation();
  });

  document.documentElement.addEventListener("keydown", (event) => {
    if (!["Enter", " "].includes(event.key) || !event.target.matches?.('[role="button"][onclick]')) return;
    event.preventDefault();
    event.stopPropagation();
    event.target.click();
  });

  lpn.small = matchMedia("(max-width: 1100px)");
  lpn.small.addEventListener("change", () => lpn.send("small", lpn.small.matches));

  // On a phone the panels are a sheet over the page, and the stage takes the rest.
  const phone = matchMedia("(max-width: 36em)");
  const sheet = new ResizeObserver(([entry]) => {
    const height = entry.target.getBoundingClientRect().height;
    document.documentElement.style.setProperty("--lpn-sheet", height + "px");
  });
  const stage = new ResizeObserver(([entry]) => {
    const { width, height } = entry.contentRect;
    clearTimeout(stage.sending);
    stage.sending = setTimeout(() => {
      lpn.send("viewport", [Math.round(width), Math.round(height)]);
      // On a resize viser may report the camera with the size of before, and the stage would be framed for that.
      window.__viserMutable?.sendCamera?.();
    }, 250);
  });
  lpn.watch = () => {
    const canvas = document.querySelector("canvas[data-engine]");
    if (canvas) stage.observe(canvas);
    canvas?.closest('div[style*="flex-grow: 1"]')?.classList.add("lpn-stage");
    sheet.disconnect();
    const panel = document.querySelector('.mantine-Paper-root[style*="max-height: 60%"]');
    if (panel) sheet.observe(panel);
  };
  // A part of the sheet that opens lies below its visible part: scroll to it.
  lpn.reveal = (selector, tries = 20) => {
    const target = document.querySelector(selector);
    if (!phone.matches || !tries) return;
    if (!target?.offsetHeight) return setTimeout(() => lpn.reveal(selector, tries - 1), 250);
    setTimeout(() => target.scrollIntoView({ block: "start", behavior: "smooth" }), 300);
  };
  // Open a tab of a window by its name, as soon as the window is in the page.
  lpn.tab = (name, tries = 40) => {
    const tabs = [...document.querySelectorAll('[role="tab"]')];
    const tab = tabs.find((one) => one.textContent.trim() === name && one.offsetHeight);
    if (!tab) return tries && setTimeout(() => lpn.tab(name, tries - 1), 250);
    tab.click(); // viser's tabs take it on a phone only, and a key elsewhere only
    tab.dispatchEvent(new KeyboardEvent("keydown", { key: "Enter", bubbles: true }));
    if (phone.matches) setTimeout(() => tab.scrollIntoView({ block: "start", behavior: "smooth" }), 300);
  };
  phone.addEventListener("change", () => setTimeout(lpn.watch, 300));
})();
