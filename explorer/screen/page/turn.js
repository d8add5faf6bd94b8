// Turning the photo by hand: drag, wheel, or keys. The picture follows at once; the numbers come from the server.

import { find } from "./dom.js";

const WHEEL = 0.15; // degrees of a unit of the wheel
const STILL = 4; // pixels that a click may move

/**
 * @param {any} figure of the photo
 * @param {{photo: () => any, angle: () => number, turn: (angle: number) => void, end: () => void}} hand
 * @returns {() => boolean} whether the photo is being dragged
 */
export const makeTurnable = (figure, hand) => {
  const frame = find(".frame", figure);
  const around = (event) => {
    const box = frame.getBoundingClientRect();
    return (Math.atan2(event.clientY - box.top - box.height / 2, event.clientX - box.left - box.width / 2) * 180) / Math.PI;
  };
  let from = null;
  let moved = false;
  frame.addEventListener("pointerdown", (event) => {
    if (!hand.photo() || event.button) return;
    try {
      frame.setPointerCapture(event.pointerId);
    } catch {} // a pointer that has gone
    from = { turned: around(event), x: event.clientX, y: event.clientY, angle: hand.angle() };
    moved = false;
  });
  frame.addEventListener("pointermove", (event) => {
    if (!from || !hand.photo()) return;
    moved ||= Math.hypot(event.clientX - from.x, event.clientY - from.y) > STILL;
    if (!moved) return;
    const whole = find(".pan", figure).clientWidth;
    const by = hand.photo().around ? (-(event.clientX - from.x) / whole) * 360 : from.turned - around(event);
    hand.turn(from.angle + by);
  });
  const end = () => {
    if (!from) return;
    from = null;
    hand.end();
  };
  frame.addEventListener("pointerup", end);
  frame.addEventListener("pointercancel", end);
  frame.addEventListener("click", (event) => moved && event.stopImmediatePropagation());
  frame.addEventListener("wheel", (event) => {
    if (!hand.photo() || event.ctrlKey) return;
    event.preventDefault();
    hand.turn(hand.angle() - WHEEL * (event.deltaMode ? 20 * event.deltaY : event.deltaY));
  }, { passive: false });
  return () => from !== null;
};
