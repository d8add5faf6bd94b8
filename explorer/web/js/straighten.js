// A button on the stage that undoes a person's turns of the camera. The server points the camera, too, which counts as straight.
(() => {
  const lpn = window.lpn;
  if (lpn.straighten) return;
  // Milliseconds between two looks at the camera, and those in which it still glides after a drag.
  const PERIOD = 150, GLIDE = 1500;
  let straight = null; // how the camera was turned before the person turned it
  let seen = null, held = false, acted = -Infinity;
  const button = document.createElement("button");
  button.id = "lpn-straighten";
  button.type = "button";
  button.textContent = "⟲ Straighten";
  button.title = "Point the camera at the pictures again";
  button.onclick = () => lpn.straighten();

  // The camera's orientation: a pan or a zoom is no turn.
  const pose = () => {
    const camera = lpn.viser.camera();
    return camera ? camera.quaternion.toArray() : null;
  };
  const alike = (one, other) => one && other && one.every((value, i) => Math.abs(value - other[i]) < 0.01);

  lpn.straighten = () => {
    acted = -Infinity;
    lpn.send("straighten");
  };
  const acts = (event) => {
    if (event.target !== lpn.canvas()) return;
    if (event.type === "pointerdown") held = true;
    acted = performance.now();
  };
  window.addEventListener("pointerdown", acts, { capture: true, passive: true });
  window.addEventListener("wheel", acts, { capture: true, passive: true });
  for (const kind of ["pointerup", "pointercancel"])
    window.addEventListener(kind, () => held && ((held = false), (acted = performance.now())), { capture: true, passive: true });

  const follow = () => {
    const now = pose(), canvas = lpn.canvas();
    if (!now || !canvas) return;
    if (document.getElementById("lpn-stage-map")) {
      straight = null; // the map is turned as one likes, and the server points the camera when it closes
      return button.remove();
    }
    const byPerson = held || performance.now() - acted < GLIDE;
    if (!straight || (!byPerson && !alike(now, seen))) straight = now;
    seen = now;
    const size = canvas.getBoundingClientRect();
    const turned = !alike(now, straight) && !document.getElementById("lpn-first") && size.width > 0;
    if (!turned) return button.remove();
    if (!button.isConnected) document.body.append(button);
    button.style.left = size.left + 8 + "px";
    button.style.top = size.top + 48 + "px"; // below the controls
  };
  lpn.every(PERIOD, follow);
})();
