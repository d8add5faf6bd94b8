// The numbered details of a photo and of the map about it: each lights up in both, and the photo can be laid over the map.
(() => {
  const lpn = window.lpn;
  if (lpn.pins) return;
  let over = "0", of = ""; // the slider's value, and the picture that it was moved for

  lpn.pins = (page, query) => {
    const photo = /** @type {HTMLElement | null} */ (page.querySelector(".pins[tabindex]"));
    if (!photo) return;
    const status = /** @type {HTMLElement} */ (page.querySelector(".over-map .which")), numbers = photo.querySelectorAll("[data-pin]").length;
    let lit = 0;
    const light = (number) => {
      if (number === lit) return;
      lit = number;
      const alike = /** @type {NodeListOf<HTMLElement>} */ (page.querySelectorAll("[data-pin]"));
      for (const one of alike) one.classList.toggle("lit", Number(one.dataset.pin) === number);
      status.textContent = number ? [...alike].find((one) => one.classList.contains("lit")).dataset.told : status.dataset.idle;
    };
    const pointed = (event) => {
      const pin = event.target.closest("[data-pin]");
      if (pin) light(Number(pin.dataset.pin));
    };
    for (const one of page.querySelectorAll(".matched, .pinned")) {
      one.addEventListener("pointerover", pointed);
      one.addEventListener("pointerleave", (event) => /** @type {PointerEvent} */ (event).pointerType === "mouse" && light(0));
    }
    photo.onkeydown = (event) => {
      const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
      if (!step) return;
      event.preventDefault();
      event.stopPropagation();
      light(((lit || (step > 0 ? 0 : 1)) + step - 1 + numbers) % numbers + 1);
    };
    photo.onblur = () => light(0);
    const slider = /** @type {HTMLInputElement} */ (page.querySelector(".over-map input"));
    const lay = () => /** @type {HTMLElement} */ (page.querySelector(".matched")).style.setProperty("--over", String(Number(slider.value) / 100));
    if (query === of) slider.value = over;
    slider.oninput = () => {
      over = slider.value;
      of = query;
      lay();
    };
    // The page's keys would turn the query.
    slider.onkeydown = (event) => /^(Arrow|Page|Home|End)/.test(event.key) && event.stopPropagation();
    lay();
  };
})();
