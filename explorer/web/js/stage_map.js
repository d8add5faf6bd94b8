// On the stage's map: a scale bar, north, and the position under the cursor, over the scene that viser draws. It is moved as maps are:
// a drag takes the ground along.
(() => {
  const lpn = window.lpn;
  if (lpn.stageMap) return;
  // Milliseconds after which the marks follow the camera.
  const PERIOD = 150;
  // Where the bar begins and north stands on the canvas.
  const BAR = [52, 32], NORTH = [24, 22];
  // The camera's largest angle from straight down: it stays above what it looks at. The view of the pair, which may come before the
  // map is closed, has this angle exactly.
  const LOWEST = Math.PI / 2;
  let place = null, kept = null, following = 0, cursor = null, seen = "";

  const box = document.createElement("div");
  box.id = "lpn-stage-map";
  box.className = "num";
  box.innerHTML =
    '<div class="read"></div><div class="how"><span class="for-mouse">Drag to move, right button or arrow keys to turn, wheel to zoom</span><span class="for-touch">One finger moves, two turn and zoom</span></div>' +
    '<button type="button" title="Back to the pair (M or Escape)">✕ Close the map<span class="for-mouse">&nbsp;(M)</span></button><button type="button" title="Point the camera at the answer again">⟲ Reset view</button>' +
    '<div class="through"><button type="button" title="Look through the camera of the photo, and compare it with the map (Z)">◉ Look through<span class="for-mouse">&nbsp;(Z)</span></button><button type="button" aria-pressed="false" title="Look through one photo\'s camera after the other">▶ Fly along</button></div>' +
    '<canvas role="img" aria-label="Scale and north"></canvas>';
  const canvas = box.querySelector("canvas"), read = box.querySelector(".read");
  const [close, whole, through, fly] = box.querySelectorAll("button");
  close.onclick = () => lpn.send("map-close");
  whole.onclick = () => lpn.straighten();
  through.onclick = () => lpn.send("stage-through");

  // Fly from photo to photo: each is looked through for a while once it has come.
  const LOOK = 2000, WAIT = 20000;
  let flying = 0, flown = "", since = 0;
  const flyOn = () => {
    const name = document.getElementById("lpn-status")?.dataset.name || "", now = performance.now();
    if (name !== flown) [flown, since] = [name, now];
    else if (now - since > LOOK) {
      lpn.send("stage-step", "next");
      since = now + WAIT;
    }
  };
  const flyAlong = (on) => {
    clearInterval(flying);
    flying = on ? lpn.every(200, flyOn) : 0;
    fly.textContent = on ? "❚❚ Stop" : "▶ Fly along";
    fly.setAttribute("aria-pressed", String(on));
    since = performance.now();
  };
  fly.onclick = () => {
    if (!flying && !lpn.stagePhoto.on()) lpn.send("stage-through");
    flyAlong(!flying);
  };

  // The point of the ground under a place on the screen, in metres east and north; null above the horizon.
  const ground = (camera, [left, top], size) => {
    const [w, x, y, z] = lpn.viser.axes(); // from the server's axes to those of the page
    const turned = camera.quaternion.clone().set(x, y, z, w).invert();
    const eye = camera.position.clone().setFromMatrixPosition(camera.matrixWorld).applyQuaternion(turned);
    const at = [(2 * (left - size.left)) / size.width - 1, 1 - (2 * (top - size.top)) / size.height];
    const far = camera.position.clone().set(...at, 0.5).unproject(camera).applyQuaternion(turned);
    if (far.z > eye.z - 1e-9) return null;
    const t = eye.z / (eye.z - far.z);
    return [eye.x + t * (far.x - eye.x), eye.y + t * (far.y - eye.y)].map((value, axis) => (value - place.middle[axis]) * place.metres);
  };

  // viser turns the camera by a drag, also below the ground. `on`: while the map is shown.
  const steer = (on) => {
    const controls = lpn.viser.cameraControls();
    if (!controls || on === !!kept) return;
    const action = controls.constructor.ACTION;
    if (on) {
      const { mouseButtons, touches, maxPolarAngle } = controls;
      kept = [controls, { maxPolarAngle }, { ...mouseButtons }, { ...touches }];
      controls.maxPolarAngle = LOWEST;
      Object.assign(mouseButtons, { left: action.SCREEN_PAN, right: action.ROTATE });
      Object.assign(touches, { one: action.TOUCH_SCREEN_PAN, two: action.TOUCH_DOLLY_ROTATE });
    } else {
      const [before, angles, buttons, fingers] = kept;
      Object.assign(before, angles);
      Object.assign(before.mouseButtons, buttons);
      Object.assign(before.touches, fingers);
      kept = null;
    }
  };

  const drawMarks = (camera, size) => {
    const [pen] = lpn.pens.canvas(canvas);
    const { left, top } = canvas.getBoundingClientRect();
    // To the right, the ground is as far from the camera as where the bar begins: the bar is right where it lies.
    const [west, east] = [0, 40].map((right) => ground(camera, [left + BAR[0] + right, top + BAR[1]], size));
    delete box.dataset.metres;
    if (!west || !east) return;
    const metres = lpn.mapMarks.bar(pen, BAR, 40 / Math.hypot(east[0] - west[0], east[1] - west[1]), size.width);
    box.dataset.metres = String(metres);
    const turn = Math.atan2(east[1] - west[1], east[0] - west[0]);
    box.dataset.turn = turn.toFixed(3);
    lpn.mapMarks.north(pen, NORTH, turn);
  };

  const follow = () => {
    const size = lpn.canvas()?.getBoundingClientRect();
    const camera = lpn.viser.camera();
    if (!size || !camera || !lpn.viser.axes()) return;
    steer(true);
    if (!box.isConnected) document.body.append(box);
    // A window over the stage covers the marks as well.
    box.hidden = document.elementFromPoint(size.left + 24, size.bottom - 24) !== lpn.canvas();
    if (box.hidden) return;
    const now = [...camera.matrixWorld.elements, size.left, size.bottom, size.width, cursor, JSON.stringify(place)].join();
    if (now === seen) return;
    seen = now;
    box.style.left = size.left + 8 + "px";
    box.style.bottom = innerHeight - size.bottom + 8 + "px";
    drawMarks(camera, size);
    const at = cursor && ground(camera, cursor, size);
    const told = () => (place.degrees ? lpn.mapMarks.degrees(place.degrees.map(([zero, step], axis) => zero + step * at[1 - axis])) : lpn.mapMarks.metres(at));
    read.textContent = at ? told() : "";
  };

  const point = (event) => {
    const onStage = event.target === lpn.canvas();
    if (onStage && event.type === "pointerdown") box.classList.add("used"); // it is known how the map moves
    if (onStage || event.pointerType === "mouse") cursor = onStage ? [event.clientX, event.clientY] : null;
  };

  // The view that flies has been moved by hand.
  lpn.stopFlying = () => flyAlong(false);

  // `given`: the middle of the ground in the stage's units, metres of a unit, and for latitude and longitude the degrees of the
  // middle and of a metre, null of a rendered place; null without a map.
  lpn.stageMap = (given) => {
    place = given;
    box.querySelector(".through").hidden = !given?.through && !flying;
    clearInterval(following);
    for (const kind of ["pointermove", "pointerdown"]) window[given ? "addEventListener" : "removeEventListener"](kind, point, { capture: true, passive: true });
    if (!given) {
      steer(false);
      flyAlong(false);
      box.classList.remove("used");
      return box.remove();
    }
    following = lpn.every(PERIOD, follow);
    follow();
  };
})();
