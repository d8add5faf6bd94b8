// The way to the server, from the page's first moment: which address its websocket has, and why none opens.
(() => {
  const CHECK = 3000, AGAIN = 5000, PATIENCE = 5000, LONG = 20000; // ms
  const cover = document.getElementById("lpn-loading");
  const line = cover.querySelector("span");

  // The theme that was chosen in this browser, else that of an address, else the system's.
  const theme = (search) => {
    let chosen = null;
    try { chosen = localStorage.getItem("lpn-theme"); } catch {} // the browser may deny its storage
    const known = [chosen, new URLSearchParams(search).get("theme")].find((one) => one === "light" || one === "dark");
    return known ?? (matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark");
  };
  cover.classList.add(theme(location.search));

  // A proxy that serves /maps/ may redirect /maps, and a websocket follows no redirect. viser leaves the last slash out of the
  // websocket's address; it is tried with it first. All files of the page are below its folder, so its own address needs the slash.
  const chosen = new URLSearchParams(location.search).get("websocket"); // viser's parameter
  const slashed = location.pathname.endsWith("/") || /\.html?$/i.test(location.pathname);
  if (!slashed) history.replaceState(history.state, "", location.pathname + "/" + location.search + location.hash);
  const folder = new URL("./", location.href).pathname;
  const socketAt = (path) => location.origin.replace(/^http/, "ws") + path;
  const own = [...new Set([folder, folder.replace(/(.)\/$/, "$1")])].map(socketAt);
  const addresses = !chosen || own.includes(chosen) ? own : [chosen];

  // Open a websocket of our own, and close it when the server's greeting has come.
  const tryAddress = (address) =>
    new Promise((done) => {
      const number = Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16).padStart(2, "0")).join("");
      const end = (saw) => {
        clearTimeout(waiting);
        socket?.close();
        done({ address, number, saw });
      };
      const waiting = setTimeout(() => end("silent"), PATIENCE);
      let socket = null;
      try {
        socket = new WebSocket(address + "?check=" + number, ["lpn-check"]);
        socket.onmessage = () => end("open");
        socket.onclose = () => end("closed");
      } catch {
        end("closed");
      }
    });

  // viser's page sends the address to its worker, and writes it into the page's own address, which needs it nowhere.
  let worker = null;
  let address = addresses[0];
  const post = Worker.prototype.postMessage;
  const first = addresses.length > 1 ? Promise.any(addresses.map(async (one) => {
    const { saw } = await tryAddress(one);
    return saw === "open" ? one : Promise.reject();
  })).then((one) => (address = one), () => address) : null;
  Worker.prototype.postMessage = function (message, ...rest) {
    if (message?.type !== "set_server") return post.call(this, message, ...rest);
    worker = this;
    if (first) first.then(() => post.call(this, { ...message, server: address }));
    else post.call(this, { ...message, server: address }, ...rest);
  };
  const replaceState = history.replaceState;
  history.replaceState = function (state, title, ...rest) {
    if (title !== "Viser") replaceState.call(this, state, title, ...rest);
  };

  // The answer to a plain request for the websocket's address, and the server that gives it.
  const ask = async (one) => {
    try {
      const answer = await fetch(one.replace(/^ws/, "http"), { method: "HEAD", redirect: "manual", cache: "no-store", signal: AbortSignal.timeout(PATIENCE) });
      return { answered: answer.type === "opaqueredirect" ? "redirect" : String(answer.status), proxy: answer.headers.get("server") || "" };
    } catch {
      return { answered: "none", proxy: "" };
    }
  };

  // Try all addresses. Null if one is open, else the fault: its title, texts, and lines of configuration.
  const look = async () => {
    const tried = await Promise.all(addresses.map(tryAddress));
    const open = tried.find(({ saw }) => saw === "open");
    if (open) {
      address = open.address;
      return null;
    }
    if (self.origin === "null") return { title: "Another web site may not use this server", texts: ["This page is in a frame that hides its address. Open it in a tab of its own."], lines: {} };
    const asked = await Promise.all(addresses.map(ask));
    const query = new URLSearchParams({
      page: self.origin,
      folder,
      checks: tried.map(({ number }) => number).join(" "),
      at: addresses.map((one) => new URL(one).pathname).join(" "),
      answers: asked.map(({ answered }) => answered).join(" "),
      saw: tried.some(({ saw }) => saw === "silent") ? "silent" : "closed",
      proxy: asked.map(({ proxy }) => proxy).find(Boolean) || "",
    });
    const here = new URL("connection", location.href);
    try {
      const answer = await fetch(here + "?" + query, { cache: "no-store", signal: AbortSignal.timeout(PATIENCE) });
      if (answer.ok && answer.headers.get("content-type")?.includes("json")) return await answer.json();
      return {
        title: answer.status === 401 ? "A token is needed" : "LPN Explorer does not answer",
        texts: [answer.status === 401 ? "The server was started again, or this browser has lost its cookie. Open the link that the server printed." : `The address ${here.pathname} is answered with ${answer.status} by something in between, such as a proxy. Check that the server is running, and that the proxy sends all below ${folder} to it.`],
        lines: {},
      };
    } catch {
      return { title: "LPN Explorer does not answer", texts: ["The server, or the way to it, is gone. Check that it is running."], lines: {} };
    }
  };

  const make = (name, text, parent) => Object.assign(parent.appendChild(document.createElement(name)), { textContent: text });
  const show = (fault) => {
    const text = JSON.stringify(fault);
    const shown = document.getElementById("lpn-fault");
    if (shown?.dataset.fault === text) return;
    shown?.remove();
    line.hidden = !!fault;
    if (!fault) return;
    const box = make("div", "", cover);
    box.id = "lpn-fault";
    box.dataset.fault = text;
    make("h1", fault.title, box);
    for (const one of fault.texts) make("p", one, box);
    const lines = Object.entries(fault.lines);
    if (lines.length) {
      const list = make("dl", "", box);
      for (const [kind, some] of lines) {
        make("dt", kind, list);
        make("dd", some.join("\n"), list);
      }
    }
    make("small", (lines.length ? "docs/serving.md has whole configurations. " : "") + "This page goes on by itself as soon as it can.", box);
  };

  // Until the page's script removes the cover. viser tries again only while its window has the focus.
  const watch = async () => {
    if (!cover.isConnected) return;
    const before = !!document.getElementById("lpn-fault");
    const fault = await look();
    if (!cover.isConnected) return;
    show(fault);
    if (!fault && before && worker) post.call(worker, { type: "set_server", server: address });
    setTimeout(watch, AGAIN);
  };
  setTimeout(watch, CHECK);
  setTimeout(() => (line.textContent = "LPN Explorer is still opening. If this lasts, check that its server is running, and reload the page."), LONG);
  window.lpnWay = { look, theme };
})();
