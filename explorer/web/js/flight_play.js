// The frame that the flight window shows: chosen by a person or by playing. The window follows at once, the stage when it can.
(() => {
  const lpn = window.lpn;
  const { flight } = lpn;
  if (flight.play) return;
  // Milliseconds that playing waits for the stage, between two looks at the clock, and between two frames that the stage is asked for.
  const PATIENCE = 8000, TICK = 50, ASK = 150;
  let pending = null; // the frame that the stage was asked for, and since when
  let asked = 0, ticking = 0, position = 0, last = 0;
  const busy = () => pending && performance.now() - pending.since < PATIENCE;

  flight.choose = (frame) => {
    if (!flight.data || frame < 0 || frame >= flight.total()) return;
    if (frame === flight.chosen && !pending) return;
    flight.chosen = frame;
    position = frame;
    flight.fillLegend();
    pending = { frame: frame, since: performance.now() };
    if (!asked) ask();
    flight.draw();
  };
  // A drag over the timeline asks for few of the frames on its way.
  const ask = () => {
    const { frame } = pending;
    lpn.send("flight-frame", frame);
    asked = setTimeout(() => {
      asked = 0;
      if (pending && pending.frame !== frame) ask();
    }, ASK);
  };
  const tick = () => {
    if (!flight.root?.isConnected) return play.turn(false);
    const now = performance.now(), end = flight.total() - 1;
    position += (Number(flight.find("[data-act=speed]").value) * (now - last)) / 1000;
    last = now;
    const frame = Math.min(Math.floor(position), end);
    // A frame that comes while the stage still works on an earlier one is skipped; the next takes its place.
    const waits = busy();
    if (frame !== flight.chosen && !waits) {
      play.skipped += Math.max(frame - flight.chosen - 1, 0);
      const at = position;
      flight.choose(frame);
      position = at;
    }
    if (frame >= end && !waits) play.turn(false);
  };
  const play = (flight.play = {
    on: false,
    skipped: 0, // frames that the stage was too slow for
    turn: (on = !play.on) => {
      clearInterval(ticking);
      play.on = on && !!flight.data;
      if (play.on) {
        play.skipped = 0;
        if (flight.chosen >= flight.total() - 1) flight.choose(0);
        position = Math.max(flight.chosen, 0);
        last = performance.now();
        ticking = lpn.every(TICK, tick);
      }
      flight.mark();
    },
    // Take the frame that the stage shows now; return false while the stage is on its way to another.
    arrived: () => {
      const { followed } = flight;
      if (followed && busy() && followed.frame !== pending.frame) return false;
      pending = null;
      const frame = followed ? followed.frame : -1;
      if (frame !== flight.chosen && !play.on) position = frame;
      flight.chosen = frame;
      return true;
    },
  });
})();
