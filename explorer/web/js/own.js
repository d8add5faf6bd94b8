// A person's own pictures: one or many, chosen, or dropped on the page as files or folders.
// They go through viser's own upload button, one after the other: the server asks for each by `lpn.own.go`.
(() => {
  const lpn = window.lpn;
  if (lpn.own) return;
  const PICTURE = /\.(jpe?g|png|webp)$/i, TYPES = /^image\/(jpeg|png|webp)$/;
  // The server's limits: bytes of a file, pictures in a batch, files that are named as left out, letters of a name, and letters
  // of all names in one message.
  const LARGEST = 30e6, MOST = 200, NAMED = 300, NAME = 80, LETTERS = 50000;
  // Entries of a dropped folder that are looked at.
  const LOOKED = 5000;
  let queue = [];
  /** @returns {HTMLInputElement} */
  const box = () => document.querySelector(lpn.viser.SELECTORS.upload);

  // The end of a name, without halves of letters, which the server does not take.
  const short = (name) => [...name].slice(-NAME).join("").replace(/\p{Surrogate}/gu, "\ufffd");
  const begin = (files, beyond = 0) => {
    if (!box()) return lpn.say(lpn.viser.field(lpn.bridge) ? "A picture of your own needs the network: open the data set with a model." : "Unfold the panel on the right first.");
    const refused = [], taken = [];
    for (const file of files) {
      const kind = file.unread ? "unread" : file.size > LARGEST ? "large" : !file.size ? "empty" : PICTURE.test(file.name) || TYPES.test(file.type) ? "" : "kind";
      if (kind) refused.push([short(file.name), kind]);
      else if (taken.length >= MOST) refused.push([short(file.name), "many"]);
      else taken.push(file);
    }
    queue = taken;
    lpn.say(taken.length ? "Reading " + taken.length + " pictures" : "There is no picture to read.");
    let room = LETTERS;
    const named = refused.slice(0, NAMED).filter((one) => (room -= JSON.stringify(one).length + 1) > 0);
    lpn.send("own-begin", [taken.length, named, refused.length - named.length + beyond]);
  };
  const put = (file) => {
    const input = box(), one = new DataTransfer();
    if (!input) return;
    one.items.add(file);
    input.files = one.files;
    input.dispatchEvent(new Event("change", { bubbles: true }));
  };
  // A file is read whole before viser announces it: viser says nothing of a file that fails.
  const whole = async (file) => {
    const read = await file.arrayBuffer().catch(() => null);
    return read && new File([read], file.name, { type: file.type });
  };
  const one = async (file) => {
    const read = await whole(file);
    if (read) put(read);
    else lpn.say(short(file.name) + " cannot be read by the browser; check that it is still there and that you may read it.", 8);
  };
  const go = async (number, total) => {
    const batch = queue, file = queue[number];
    if (!file) return; // the page was loaded again, or the script ran again
    queue[number] = null;
    if (total > 1) {
      lpn.work(number, total);
      lpn.say("Reading picture " + (number + 1) + " of " + total, 20);
    }
    const read = await whole(file);
    while (!box()) await new Promise((done) => setTimeout(done, 500)); // while the right panel is folded, nothing can be sent
    if (batch !== queue) return;
    if (read) put(read);
    else lpn.send("own-skip", [number, short(file.name)]);
  };

  const take = (files, beyond = 0) => (files.length === 1 && !files[0].unread && files[0].size <= LARGEST && box() ? one(files[0]) : begin(files, beyond));
  // viser's own chooser may lie in a part of the page that takes no input.
  const choose = (options) => {
    const chooser = Object.assign(document.createElement("input"), { type: "file", ...options });
    // The hint on the choice goes with the chooser: on a phone it lies over the heading.
    for (const kind of ["change", "cancel"]) chooser.addEventListener(kind, () => document.getElementById("lpn-notice")?.classList.remove("shown"));
    chooser.addEventListener("change", () => take([...chooser.files]));
    chooser.click();
  };
  lpn.upload = () => {
    if (lpn.screen() !== "first") lpn.say(lpn.ownHint, 8); // beside the system's chooser; the first screen has said it
    choose({ multiple: true, accept: "image/jpeg,image/png,image/webp" });
  };
  const folder = () => choose({ webkitdirectory: true });

  // All files of what was dropped, folders included.
  /** @returns {Promise<[any[], number]>} */
  const walk = async (entries) => {
    const files = [];
    let looked = 0, beyond = 0;
    const all = [...entries];
    while (all.length) {
      const entry = all.shift();
      if (++looked > LOOKED) {
        beyond++;
        continue;
      }
      if (entry.isFile) {
        files.push(await new Promise((done) => entry.file(done, () => done({ name: entry.name, unread: true }))));
      } else {
        const reader = entry.createReader();
        for (;;) {
          const some = await new Promise((done) => reader.readEntries(done, () => done(null)));
          if (!some) files.push({ name: entry.name, unread: true });
          if (!some?.length) break;
          all.push(...some.sort((one, two) => one.name.localeCompare(two.name, "en", { numeric: true })));
        }
      }
    }
    return [files, beyond];
  };
  const sign = document.body.appendChild(document.createElement("div"));
  sign.id = "lpn-drop";
  sign.innerHTML = "<div>Drop pictures or a folder here:<br>they become queries</div>";
  const holds = (event) => [...(event.dataTransfer?.types || [])].includes("Files");
  let leaving = 0;
  addEventListener("dragover", (event) => {
    if (!holds(event)) return;
    event.preventDefault();
    clearTimeout(leaving);
    leaving = setTimeout(() => sign.classList.remove("shown"), 400);
    sign.classList.add("shown");
  });
  addEventListener("drop", async (event) => {
    if (!holds(event)) return;
    event.preventDefault();
    sign.classList.remove("shown");
    const entries = [...event.dataTransfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
    const loose = [...event.dataTransfer.files];
    /** @type {[any[], number]} */
    const [files, beyond] = entries.length ? await walk(entries) : [loose, 0];
    take(files, beyond);
  });
  lpn.own = { go: go, folder: folder, take: take };
})();
