// How the page sits on its screen: styles, messages, room for the stage, and keys that are the app's alone.
(() => {
  const lpn = window.lpn;
  if (lpn.head) return;

  const element = (id, parent) => {
    const found = document.getElementById(id) || parent.appendChild(document.createElement("div"));
    found.id = id;
    return found;
  };

  // Styles that stand in a panel are gone when it is folded.
  lpn.head = (html) => {
    const holder = element("lpn-head", document.body);
    holder.hidden = true;
    if (holder.innerHTML !== html) holder.innerHTML = html;
  };

  lpn.say = (text, seconds = 4) => {
    const said = element("lpn-said", document.body);
    said.setAttribute("role", "status");
    said.textContent = text;
    said.classList.add("shown");
    clearTimeout(said.hiding);
    if (seconds) said.hiding = setTimeout(() => said.classList.remove("shown"), 1000 * seconds);
  };

  // viser shades the panels while nobody answers, and goes on when somebody does.
  let lost = false;
  setInterval(() => {
    const shade = document.getElementById("lpn-header")?.closest('div[style*="transition: opacity 150ms"]');
    const now = !!shade && parseFloat(shade.style.opacity) < 1;
    if (now && !lost) lpn.say("The server does not answer. Start it again: the page goes on with what you see.", 0);
    if (lost && shade && !now) lpn.say("The server answers again.");
    if (shade) lost = now;
  }, 1000);

  lpn.upload = () => document.querySelector('input[type="file"]')?.click();

  // The command palette gives the focus back where it was when it closes, so this comes after it.
  lpn.focus = (uuid) =>
    setTimeout(() => (lpn.field(uuid) ? lpn.field(uuid).focus() : lpn.say("Unfold the panel Query first.")), 400);

  // viser moves the camera by these keys, which are commands here.
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

  // On a phone the panels are a sheet over the page; the stage gets what it leaves of it.
  const phone = matchMedia("(max-width: 36em)");
  const sheet = new ResizeObserver(([entry]) => {
    const height = entry.target.getBoundingClientRect().height;
    document.documentElement.style.setProperty("--lpn-sheet", height + "px");
  });
  const room = new ResizeObserver(([entry]) => {
    const { width, height } = entry.contentRect;
    clearTimeout(room.telling);
    room.telling = setTimeout(() => lpn.send("room", [Math.round(width), Math.round(height)]), 250);
  });
  lpn.watch = () => {
    const canvas = document.querySelector("canvas[data-engine]");
    if (canvas) room.observe(canvas);
    canvas?.closest('div[style*="flex-grow: 1"]')?.classList.add("lpn-stage");
    sheet.disconnect();
    const panel = document.querySelector('.mantine-Paper-root[style*="max-height: 60%"]');
    if (panel) sheet.observe(panel);
  };
  // What opens in the sheet opens below what is seen of it.
  lpn.reveal = (selector, tries = 20) => {
    const found = document.querySelector(selector);
    if (!phone.matches || !tries) return;
    if (!found?.offsetHeight) return setTimeout(() => lpn.reveal(selector, tries - 1), 250);
    setTimeout(() => found.scrollIntoView({ block: "start", behavior: "smooth" }), 300);
  };
  phone.addEventListener("change", () => setTimeout(lpn.watch, 300));
})();
