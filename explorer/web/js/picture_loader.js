// Pictures that a canvas draws: loaded a few at a time as they are needed, kept up to a number, and asked for again after a failure.
(() => {
  const lpn = window.lpn;
  if (lpn.pictureLoader) return;
  const LOADING = 6;
  // Milliseconds until a picture that could not be loaded is asked for again, twice as many after each failure, and failures after
  // which it is left out.
  const RETRY = 2000, ATTEMPTS = 6;

  // `redraw` is called when a picture has come, or may be asked for again; `kept` is the number of pictures in memory.
  lpn.pictureLoader = (redraw, kept) => {
    const images = new Map(); // by address, the least recently drawn first
    const load = (address, failures) => {
      const one = Object.assign(new Image(), { ready: false, failures: 0, again: NaN });
      images.set(address, one);
      one.onload = () => ((one.ready = true), redraw());
      one.onerror = () => {
        one.failures = failures + 1;
        if (one.failures === ATTEMPTS) return redraw();
        const wait = RETRY * 2 ** failures;
        one.again = performance.now() + wait;
        setTimeout(redraw, wait + 100);
        redraw();
      };
      one.src = address;
    };
    const due = (one) => !one || performance.now() > one.again;
    return {
      // A picture that has come, else null.
      image: (address) => {
        const found = images.get(address);
        if (!found) return null;
        images.delete(address);
        images.set(address, found);
        return found.ready ? found : null;
      },
      // Load the first of these pictures that are due; the others wait until they are requested again.
      request: (addresses) => {
        let busy = [...images.values()].filter((one) => !one.ready && !one.failures).length;
        for (const address of addresses) {
          const known = images.get(address);
          if (busy >= LOADING) break;
          if (!due(known)) continue;
          load(address, known ? known.failures : 0);
          busy++;
        }
        for (const [address, one] of images) {
          if (images.size <= kept) break;
          if (one.ready || one.failures) images.delete(address);
        }
      },
      clear: () => images.clear(),
    };
  };
})();
