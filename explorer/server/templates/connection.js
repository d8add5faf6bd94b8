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

  // Open a websocket of our own, and close it when the server's greeting has come: whether it came.
  const opens = (address) =>
    new Promise((done) => {
      const end = (open) => {
        clearTimeout(waiting);
        socket?.close();
        done(open);
      };
      const waiting = setTimeout(() => end(false), PATIENCE);
      let socket = null;
      try {
        socket = new WebSocket(address, ["lpn-check"]);
        socket.onmessage = () => end(true);
        socket.onclose = () => end(false);
      } catch {
        end(false);
      }
    });
  const firstOpen = () => Promise.any(addresses.map(async (one) => ((await opens(one)) ? one : Promise.reject()))).then((one) => (address = one));

  // viser's page sends the address to its worker, and writes it into the page's own address, which needs it nowhere.
  let worker = null;
  let address = addresses[0];
  const post = Worker.prototype.postMessage;
  const first = addresses.length > 1 ? firstOpen().catch(() => {}) : null;
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

  // Say why no websocket opens; empty if one does.
  const look = async () => {
    if (await firstOpen().catch(() => "")) return "";
    if (self.origin === "null") return "This page is in a frame that hides its address. Open it in a tab of its own.";
    try {
      const { status } = await fetch("pictures/", { cache: "no-store", signal: AbortSignal.timeout(PATIENCE) });
      if (status === 401) return "A token is needed. Open the link that the server printed.";
      if (status < 500) return "Pages of LPN Explorer arrive, but its websockets do not. A proxy in between must pass the headers Host, Upgrade, Connection, and Sec-WebSocket-Protocol; see docs/serving.md.";
    } catch {} // no answer
    return "LPN Explorer does not answer. Check that its server is running.";
  };

  const show = (fault) => {
    const shown = document.getElementById("lpn-fault");
    if ((shown?.dataset.fault ?? "") === fault) return;
    shown?.remove();
    line.hidden = !!fault;
    if (!fault) return;
    const text = cover.appendChild(document.createElement("p"));
    text.id = "lpn-fault";
    text.dataset.fault = fault;
    text.textContent = fault + " This page goes on by itself as soon as it can.";
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
