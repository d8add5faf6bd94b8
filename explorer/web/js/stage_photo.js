// The photo over the view through its camera on the stage's map: a swipe between the photo and the map as its pose shows it. A view
// that a person moves is no longer the photo's, so the photo goes. The server's own moves are none: they come before or after the photo.
(() => {
  const lpn = window.lpn;
  if (lpn.stagePhoto) return;
  const PERIOD = 150; // milliseconds between two looks at the stage's size
  const box = document.createElement("div");
  box.id = "lpn-stage-photo";
  box.innerHTML = '<img alt="The photo"><input type="range" min="0" max="100" value="50" aria-label="Swipe between the photo and the map" title="Photo to the left, map to the right">';
  const image = box.querySelector("img"), swipe = box.querySelector("input");
  let photo = null, watching = 0, controls = null;

  const lay = () => (image.style.clipPath = `inset(0 ${100 - Number(swipe.value)}% 0 0)`);
  swipe.oninput = lay;
  const stop = () => {
    clearInterval(watching);
    watching = 0;
    controls?.removeEventListener("control", away);
    document.removeEventListener("keydown", steer);
    box.remove();
  };
  const away = () => {
    photo = null;
    stop();
    lpn.stopFlying();
    lpn.send("stage-away");
  };
  const steer = ({ key, target }) => {
    if (key.startsWith("Arrow") && !target.closest?.("input,textarea,select")) away();
  };
  const follow = () => {
    const size = lpn.canvas()?.getBoundingClientRect();
    if (!size || !photo) return;
    if (!box.isConnected) document.body.append(box);
    // A window over the stage covers the photo as well.
    box.hidden = document.elementFromPoint(size.left + 24, size.bottom - 24) !== lpn.canvas() && !document.querySelector("#lpn-stage-map:not([hidden])");
    // The whole photo fits into the view.
    const width = Math.min(size.width, size.height * photo.aspect), height = width / photo.aspect;
    Object.assign(box.style, { left: size.left + (size.width - width) / 2 + "px", top: size.top + (size.height - height) / 2 + "px", width: width + "px", height: height + "px" });
  };

  // `given`: the photo as an address, its aspect, and how often it was hidden or shown; null without one.
  lpn.stagePhoto = Object.assign(
    (given) => {
      if (given && photo && given.source === photo.source && given.flips !== photo.flips) {
        swipe.value = Number(swipe.value) > 0 ? "0" : "100";
        photo = given;
        return lay();
      }
      photo = given;
      if (!given) return stop();
      image.src = given.source;
      lay();
      if (!watching) {
        watching = lpn.every(PERIOD, follow);
        controls = lpn.viser.cameraControls();
        controls?.addEventListener("control", away);
        document.addEventListener("keydown", steer);
      }
      follow();
    },
    { on: () => photo !== null },
  );
})();
