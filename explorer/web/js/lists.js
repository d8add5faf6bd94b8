// Lists that scroll: the entries in sight are fetched in pieces and drawn. Elements and pieces in memory are bounded in number.
// The server hands over each list by `lpn.list(id, data)`; its element may come later, and may be replaced.
(() => {
  const lpn = window.lpn;
  if (lpn.list) return;
  // Entries in a piece, pieces in memory, pieces that load at once, and milliseconds until a refused one is asked for again.
  const CHUNK = 100, KEPT = 40, LOADING = 3, RETRY = 1000;
  // Rows drawn beyond each end of what is in sight.
  const MARGIN = 3;
  // Pictures wait while more than this many heights of the list pass in a frame, and for so many milliseconds after that.
  const FAST = 1, REST = 90;
  // Attempts to load a picture.
  const ATTEMPTS = 4;
  // Browsers cut elements above some 17 million pixels: a longer list scrolls in proportion.
  const LONGEST = 12e6;
  const { clamp } = lpn;

  const feed = (address, arrived) => {
    const pieces = new Map(); // by number, the oldest first
    const load = async (number) => {
      const piece = { control: new AbortController(), entries: null };
      pieces.set(number, piece);
      try {
        const answer = await fetch(address + number, { signal: piece.control.signal });
        if ([204, 404].includes(answer.status)) return; // a newer list is on its way
        if (answer.ok) piece.entries = await answer.json();
      } catch {
        if (piece.control.signal.aborted) return;
      }
      if (!piece.entries) setTimeout(() => (pieces.delete(number), arrived()), RETRY);
      else arrived();
    };
    return {
      entry: (index) => pieces.get(Math.floor(index / CHUNK))?.entries?.[index % CHUNK],
      want: (first, last) => {
        const [low, high] = [Math.floor(first / CHUNK), Math.floor((last - 1) / CHUNK)];
        for (const [number, piece] of pieces) {
          if (piece.entries || (number >= low && number <= high)) continue;
          piece.control.abort();
          pieces.delete(number);
        }
        let loading = [...pieces.values()].filter((piece) => !piece.entries).length;
        for (let number = low; number <= high; number++) {
          const known = pieces.get(number);
          if (known?.entries) pieces.delete(number), pieces.set(number, known);
          else if (!known && loading++ < LOADING) load(number);
        }
        for (const [number, piece] of pieces) {
          if (pieces.size <= KEPT) break;
          if (piece.entries && (number < low || number > high)) pieces.delete(number);
        }
      },
      close: () => pieces.forEach((piece) => piece.control.abort()),
    };
  };

  const show = (picture, attempt = 1) => {
    const address = picture.dataset.src;
    if (!address || !picture.isConnected) return;
    picture.onload = () => picture.classList.add("there");
    picture.onerror = () => attempt < ATTEMPTS && setTimeout(() => (picture.removeAttribute("src"), show(picture, attempt + 1)), RETRY * attempt);
    picture.src = address;
  };
  const drop = (node) => {
    // Without its address, a picture that is still loading is called off.
    node.querySelectorAll("img[src]").forEach((picture) => (picture.onerror = null, picture.removeAttribute("src")));
    node.remove();
  };

  // How each kind of list is laid out: entries beside one another with their pictures, or rows of a table.
  // The end of a long name: pictures of a flight differ there alone.
  const ending = (name) => {
    const stem = name.replace(/\.\w{2,5}$/, "");
    return stem.length > 7 ? "\u2026" + stem.slice(-5) : stem;
  };
  const SIGNS = { 1: ["✓", "right", "found"], 0: ["✗", "wrong", "failed"] };
  const KINDS = {
    queries: {
      measure: (root) => {
        const width = root.clientWidth, columns = Math.max(2, Math.floor(width / 60));
        return [columns, Math.floor(width / columns) + 21];
      },
      make: ([query, name, right], data) => {
        const node = document.createElement("div");
        const sign = SIGNS[right];
        node.className = "thumb";
        node.dataset.query = query;
        node.title = name;
        node.setAttribute("role", "option");
        node.setAttribute("aria-label", name + (sign ? ", " + sign[2] : ""));
        const picture = node.appendChild(document.createElement("img"));
        picture.alt = "";
        picture.dataset.src = data.pictures + query;
        const label = node.appendChild(document.createElement("span"));
        if (sign) {
          const mark = label.appendChild(document.createElement("b"));
          mark.style.color = "var(--lpn-" + sign[1] + ")";
          mark.textContent = sign[0];
          label.append(" ");
        }
        label.append(ending(name));
        return node;
      },
      blank: () => Object.assign(document.createElement("div"), { className: "thumb blank" }),
      place: (root, nodes, first, last, [columns, height], top) => {
        const width = Math.floor(root.clientWidth / columns);
        const box = root.firstElementChild;
        for (const [index, node] of nodes) {
          const row = Math.floor(index / columns);
          node.style.transform = "translate(" + (index % columns) * width + "px," + (row * height + top) + "px)";
          node.style.width = width + "px";
          node.style.height = height - 3 + "px";
          if (!node.isConnected) box.append(node);
        }
      },
      extent: (root, height) => (root.firstElementChild.style.height = height + "px"),
      pick: (entry, data) => lpn.send(data.message, [data.task, entry[0]]),
    },
    table: {
      measure: (root) => [1, parseFloat(getComputedStyle(root).getPropertyValue("--lpn-row"))],
      make: ([row, html]) => {
        const node = document.createElement("tr");
        node.dataset.row = row;
        node.setAttribute("role", "row");
        node.innerHTML = '<td class="mark" role="gridcell" title="Choose (also Ctrl or Shift and click)"><i></i></td>' + html;
        return node;
      },
      blank: (root) => {
        const node = document.createElement("tr");
        node.className = "blank";
        node.innerHTML = "<td colspan=" + root.querySelectorAll("th").length + "></td>";
        return node;
      },
      place: (root, nodes, first, last, [, height], top, total) => {
        const body = root.querySelector("tbody");
        const [above, below] = [body.firstElementChild, body.lastElementChild];
        const wanted = [];
        for (let index = first; index < last; index++) wanted.push(nodes.get(index));
        above.firstElementChild.style.height = first * height + top + "px";
        below.firstElementChild.style.height = Math.max(total - last * height - top, 0) + "px";
        if (wanted.some((node, i) => body.children[i + 1] !== node)) body.replaceChildren(above, ...wanted, below);
      },
      // Columns only grow while one scrolls; otherwise they would move with what is in sight. Each asks for what its contents need,
      // so that the room beyond is shared anew in another width, or by longer contents.
      rest: (root) => {
        const heads = [...root.querySelectorAll("th")], table = root.querySelector("table");
        table.style.width = "max-content";
        const widths = heads.map((head) => Math.ceil(head.getBoundingClientRect().width));
        table.style.width = "";
        heads.forEach((head, i) => widths[i] > (head._width || 0) && (head.style.minWidth = (head._width = widths[i]) + "px"));
      },
      extent: () => {},
      pick: (entry) => lpn.send("lab-open", entry[0]),
      choose: (how, first, last = first) => lpn.send("lab-rows", [first[0], last[0], how]),
      chooseAll: (all) => lpn.send(all ? "lab-rows-all" : "lab-rows-none"),
    },
  };

  const List = (root, kind) => {
    const layout = KINDS[kind], nodes = new Map();
    let data = null, source = null, cursor = -1, anchor = null, frame = 0, last = { top: 0, fast: 0 }, key = "";
    let hidden = -1; // the entry to bring into sight when the list is shown again
    const rows = (columns) => Math.ceil(data.total / columns);
    // A list longer than a browser's longest element scrolls in proportion.
    const heights = (columns, height) => {
      const whole = rows(columns) * height, extent = Math.min(whole, LONGEST);
      const room = Math.max(root.clientHeight, 1);
      const ratio = extent > room && whole > extent ? (whole - room) / (extent - room) : 1;
      return [whole, extent, ratio];
    };
    const soon = () => (frame ||= requestAnimationFrame(draw));
    const draw = () => {
      frame = 0;
      if (!data || !root.isConnected || !root.clientWidth) return;
      if (hidden >= 0) reveal(hidden);
      const [columns, height] = layout.measure(root);
      const [, extent, ratio] = heights(columns, height);
      if (key !== columns + "," + height) {
        key = columns + "," + height;
        clear();
      }
      layout.extent(root, extent);
      const fast = Math.abs(root.scrollTop - last.top) * ratio > FAST * root.clientHeight;
      last = { top: root.scrollTop, fast: fast ? performance.now() : last.fast };
      const at = root.scrollTop * ratio, shift = root.scrollTop - at;
      const first = clamp(Math.floor(at / height) - MARGIN, 0, rows(columns)) * columns;
      const end = Math.min((Math.ceil((at + root.clientHeight) / height) + MARGIN) * columns, data.total);
      source.want(first, Math.max(end, first + 1));
      for (const [index, node] of nodes) if (index < first || index >= end) drop(node), nodes.delete(index);
      for (let index = first; index < end; index++) {
        const entry = source.entry(index);
        const known = nodes.get(index);
        if (known && (known._entry || !entry)) continue;
        const node = entry ? layout.make(entry, data) : layout.blank(root);
        node._entry = entry;
        node.id = root.id + "-" + index;
        if (known) known.remove();
        nodes.set(index, node);
      }
      mark();
      layout.place(root, nodes, first, end, [columns, height], shift, extent);
      const wait = last.fast + REST - performance.now();
      if (wait > 0) setTimeout(soon, wait);
      else {
        layout.rest?.(root);
        nodes.forEach((node) => node.querySelectorAll("img[data-src]:not([src])").forEach((picture) => show(picture)));
      }
      root.dataset.drawn = [first, end];
    };
    const clear = () => (nodes.forEach(drop), nodes.clear());
    const mark = () => {
      for (const [index, node] of nodes) {
        node.classList.toggle("chosen", index === data.chosen);
        node.classList.toggle("cursor", index === cursor);
        const marked = !!data.marked?.some(([first, end]) => index >= first && index <= end);
        node.classList.toggle("marked", marked);
        node.setAttribute("aria-selected", layout.choose ? marked : index === data.chosen);
        if (layout.choose) node.setAttribute("aria-current", index === data.chosen);
        node.setAttribute(kind === "table" ? "aria-rowindex" : "aria-posinset", index + (kind === "table" ? 2 : 1));
        if (kind === "queries") node.setAttribute("aria-setsize", data.total);
      }
      if (nodes.has(cursor)) root.setAttribute("aria-activedescendant", root.id + "-" + cursor);
      else root.removeAttribute("aria-activedescendant");
    };
    const reveal = (index) => {
      if (index < 0 || !root.clientHeight) return void (hidden = index);
      hidden = -1;
      const [columns, height] = layout.measure(root);
      const [, , ratio] = heights(columns, height);
      const head = root.querySelector("thead")?.offsetHeight || 0;
      const top = Math.floor(index / columns) * height, room = root.clientHeight - head;
      const at = root.scrollTop * ratio;
      if (top < at) root.scrollTop = top / ratio;
      else if (top + height > at + room) root.scrollTop = (top + height - room) / ratio;
      soon();
    };
    // Where keys begin: at the cursor, else at the chosen entry if it is in sight, else at the first entry in sight.
    const start = () => {
      if (cursor >= 0) return cursor;
      const [columns, height] = layout.measure(root), [, , ratio] = heights(columns, height);
      const head = root.querySelector("thead")?.offsetHeight || 0, top = root.scrollTop * ratio;
      const first = Math.ceil(top / height) * columns, end = Math.floor((top + root.clientHeight - head) / height) * columns;
      return data.chosen >= first && data.chosen < end ? data.chosen : Math.min(first, data.total - 1);
    };
    const go = (to) => {
      cursor = clamp(to, 0, data.total - 1);
      reveal(cursor);
      draw();
    };
    const pick = (index) => {
      const entry = source.entry(index);
      if (entry) (anchor = null), (cursor = index), layout.pick(entry, data);
    };
    // Choose the row at an index by itself, or all rows from the anchor, which is the row that was last chosen by itself.
    const choose = (index, extend) => {
      const entry = source.entry(index);
      if (!entry) return;
      if (!extend || !anchor) anchor = { index, entry };
      layout.choose(extend ? "add" : "toggle", anchor.entry, entry);
      cursor = index;
      draw();
    };
    // Shift and an arrow choose all rows from the anchor to the cursor; rows that the cursor leaves on its way back are dropped.
    const extend = (from, to) => {
      if (!anchor) anchor = source.entry(from) && { index: from, entry: source.entry(from) };
      go(to);
      const [left, reached] = [source.entry(from), source.entry(cursor)];
      if (!anchor || !left || !reached) return;
      const past = (cursor - anchor.index) * (from - anchor.index) < 0, stop = past ? anchor.index : cursor;
      const back = Math.abs(stop - anchor.index) < Math.abs(from - anchor.index);
      if (back) layout.choose("drop", left, source.entry(stop + Math.sign(from - stop)) || left);
      layout.choose("add", anchor.entry, reached);
    };
    root.addEventListener("scroll", soon, { passive: true });
    root.addEventListener("click", (event) => {
      const node = event.target.closest(".thumb, tbody tr");
      const chooses = layout.choose && (event.ctrlKey || event.metaKey || event.shiftKey || event.target.closest(".mark"));
      for (const [index, one] of nodes) if (one === node) chooses ? choose(index, event.shiftKey) : pick(index);
    });
    if (layout.choose) root.addEventListener("mousedown", (event) => event.shiftKey && event.preventDefault()); // it would select text
    root.addEventListener("keydown", (event) => {
      if (!data || !data.total || event.target !== root || event.altKey) return;
      const control = event.ctrlKey || event.metaKey;
      if (control && !(layout.choose && event.key.toLowerCase() === "a")) return;
      const [columns, height] = layout.measure(root);
      const page = Math.max(Math.floor(root.clientHeight / height) - 1, 1) * columns;
      const steps = { ArrowUp: -columns, ArrowDown: columns, PageUp: -page, PageDown: page };
      if (kind === "queries") Object.assign(steps, { ArrowLeft: -1, ArrowRight: 1 });
      const from = start();
      // The next Shift begins where the cursor is then.
      if (control || event.key === "Escape" || (!event.shiftKey && (event.key in steps || event.key === "Home" || event.key === "End"))) anchor = null;
      if (control) layout.chooseAll(true);
      else if (layout.choose && event.key === "Escape" && data.marked?.length) layout.chooseAll(false);
      else if (layout.choose && event.key === " ") choose(from, event.shiftKey);
      else if (layout.choose && event.shiftKey && event.key in steps) extend(from, from + steps[event.key]);
      else if (event.key in steps) go(cursor < 0 && data.chosen !== from ? from : from + steps[event.key]);
      else if (event.key === "Home") go(0);
      else if (event.key === "End") go(data.total - 1);
      else if (event.key === "Enter" || event.key === " ") pick(from);
      else return;
      event.preventDefault();
      event.stopPropagation();
    });
    new ResizeObserver(soon).observe(root);
    return {
      root: root,
      update: (next) => {
        const other = !data || data.feed !== next.feed;
        // A list of rows keeps its place unless another one is chosen; a list of pictures always has the chosen one in sight.
        const turned = data ? data.chosen !== next.chosen || (other && next.reveal) : next.reveal;
        if (other) {
          source?.close();
          source = feed(next.address + next.feed, soon);
          cursor = -1;
          anchor = null;
          clear();
        }
        if (data && other && data.title !== next.title) root.scrollTop = 0;
        data = next;
        root.setAttribute(kind === "table" ? "aria-rowcount" : "data-total", next.total + (kind === "table" ? 1 : 0));
        if (turned) cursor = cursor < 0 ? cursor : next.chosen;
        draw();
        if (turned) reveal(next.chosen);
      },
    };
  };

  const lists = new Map(), newest = new Map();
  lpn.list = (id, data, tries = 60) => {
    if (tries === 60) newest.set(id, data);
    else if (newest.get(id) !== data) return;
    const root = document.getElementById(id);
    if (!root || (root.dataset.shell && +root.dataset.shell !== data.shell))
      return tries && setTimeout(() => lpn.list(id, data, tries - 1), 50);
    if (lists.get(id)?.root !== root) lists.set(id, List(root, data.kind));
    lists.get(id).update(data);
  };
  // viser may put another element in a list's place, without its script, while the page is being built.
  lpn.onChange(100, () => {
    for (const [id, data] of newest) {
      const root = document.getElementById(id);
      if (root && root !== lists.get(id)?.root) lpn.list(id, data);
    }
  });
})();
