// The frame of the flight window: asked for by a person or by playing, and shown when the server has sent all of it.
(() => {
  const lpn = window.lpn;
  const { flight } = lpn;
  if (flight.play) return;
  // Milliseconds after which a frame that does not come is asked for no longer, between two looks at the clock, between two
  // frames that the server is asked for, after which the window says that a frame is awaited, and after which a frame is shown
  // without its pictures.
  const PATIENCE = 8000, TICK = 50, ASK = 150, LATE = 600, PICTURES = 5000;
  let since = 0, asked = 0, ticking = 0, due = 0;
  const waits = () => flight.wanted !== null && performance.now() - since < PATIENCE;

  flight.choose = (frame) => {
    if (!flight.data || frame < 0 || frame >= flight.total()) return;
    if (frame === (flight.wanted ?? flight.chosen)) return;
    flight.wanted = frame;
    since = performance.now();
    if (!asked) ask();
    flight.draw();
    flight.mark();
    setTimeout(flight.draw, LATE);
  };
  // Go on from the frame that was asked for last.
  flight.step = (by) => flight.choose(lpn.clamp((flight.wanted ?? flight.chosen) + by, 0, flight.total() - 1));
  // A drag over the timeline asks for few of the frames on its way.
  const ask = () => {
    const frame = flight.wanted;
    lpn.send("flight-frame", frame);
    asked = setTimeout(() => {
      asked = 0;
      if (flight.wanted !== null && flight.wanted !== frame) ask();
    }, ASK);
  };
  // The addresses of a frame's pictures: those of its card, and the photo if it is laid over the map.
  const addresses = ({ address, frame }) => {
    if (!frame) return [];
    const card = new DOMParser().parseFromString(frame.card, "text/html"); // which loads nothing
    const all = [...card.querySelectorAll("img")].map((image) => image.getAttribute("src"));
    if (flight.photo.mode !== "off" && frame.homography) all.push(flight.photo.address(address, frame));
    return all;
  };
  const loaded = (source) => {
    const image = new Image();
    image.src = source;
    return image;
  };
  let newest = 0, shown = 0; // numbers of the server's messages
  let pictures = []; // of the frame that is shown; while they are held, the page has them at once
  // Show what the server tells of a frame when its pictures are there, so that no words stand beside the picture of another frame.
  // A picture that cannot be loaded, or takes too long, is left to the card.
  flight.follow = (told) => {
    const number = ++newest, sources = addresses(told), images = sources.map(loaded);
    const show = () => {
      if (number < shown) return;
      [shown, pictures] = [number, images];
      flight.arrive(told);
    };
    // The photo of another flight is gone at once: the headline is of the new one already.
    if (flight.of !== told.address && flight.of !== null) return show();
    if (sources.every((source) => pictures.some((image) => image.getAttribute("src") === source))) return show();
    const patience = new Promise((resolve) => setTimeout(resolve, PICTURES));
    Promise.race([patience, Promise.all(images.map((image) => image.decode().catch(() => {})))]).then(show);
  };
  const interval = () => 1000 / Number(flight.find("[data-act=speed]").value);
  const tick = () => {
    if (!flight.root?.isConnected) return play.turn(false);
    const now = performance.now(), end = flight.total() - 1;
    if (now < due || waits()) return;
    if (flight.chosen >= end) return play.turn(false);
    // The next frame is the next one, however long the last one took, unless a person lets frames be left out.
    const late = Math.floor((now - due) / interval());
    const frame = Math.min(flight.chosen + 1 + (play.skips ? late : 0), end);
    play.skipped += frame - flight.chosen - 1;
    play.slow = !play.skips && late > 0;
    due = play.skips ? due + (late + 1) * interval() : now + interval();
    flight.choose(frame);
  };
  const play = (flight.play = {
    on: false,
    skips: false, // frames that the page is too slow for are left out
    skipped: 0, // their number
    slow: false, // the page is slower than asked
    turn: (on = !play.on) => {
      clearInterval(ticking);
      play.on = on && !!flight.data;
      play.slow = false;
      if (play.on) {
        play.skipped = 0;
        if (flight.chosen >= flight.total() - 1) flight.choose(0);
        due = performance.now() + interval();
        ticking = lpn.every(TICK, tick);
      }
      flight.mark();
    },
    // Return whether a frame is waited for so long that it is worth a word.
    late: () => waits() && performance.now() - since >= LATE - TICK,
    // Show the frame that has come.
    arrived: () => {
      flight.chosen = flight.followed ? flight.followed.frame : -1;
      if (flight.wanted === flight.chosen || !waits()) flight.wanted = null;
    },
  });
})();
