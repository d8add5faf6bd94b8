// The page's address: what it asks for is told to the server when the page opens, and it follows what is shown.
(() => {
  const lpn = window.lpn;
  if (lpn.greet) return;
  // viser rewrites the address without escaping it, so what it said is read where it stands as it was typed.
  const opened = performance.getEntriesByType("navigation")[0];
  let asked = new URL(opened ? opened.name : location.href).search;
  let greeting = 0;
  let writing = 0;
  let ready = false;

  // Until the server answers: the page may not be listening yet.
  lpn.greet = () => {
    clearInterval(greeting);
    const hello = () => lpn.send("hello", { search: asked, small: lpn.small.matches });
    greeting = setInterval(hello, 500);
    hello();
  };

  lpn.address = (query, keys) => {
    clearInterval(greeting);
    const server = new URLSearchParams(location.search).get("websocket"); // viser's own, and it may change it
    const others = new URLSearchParams(asked);
    for (const key of [...keys, "websocket"]) others.delete(key);
    if (server) others.set("websocket", server);
    asked = "?" + [query, others.toString()].filter(Boolean).join("&");
    clearTimeout(writing); // browsers refuse an address that changes many times a second
    writing = setTimeout(() => history.replaceState(history.state, "", location.pathname + asked + location.hash), 200);
    lpn.watch();
    if (!ready) lpn.welcome();
    ready = true;
  };

  // Without https there is no clipboard but the old way.
  const copied = (text) => {
    const field = document.body.appendChild(document.createElement("textarea"));
    field.value = text;
    field.style = "position:fixed;opacity:0";
    field.select();
    const done = document.execCommand("copy");
    field.remove();
    return done;
  };

  lpn.copy = async () => {
    const own = new URLSearchParams(asked).get("query") === "own";
    const link = location.origin + location.pathname + asked + location.hash;
    let done = true;
    try {
      await navigator.clipboard.writeText(link);
    } catch {
      done = copied(link);
    }
    if (!done) lpn.say("This browser does not let pages copy: take the link from the address bar.");
    else if (own) lpn.say("Link copied. Your own picture is not in it: it stays in this browser.");
    else lpn.say("Link copied: it opens what you see.");
  };
})();
