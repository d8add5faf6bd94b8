// Thumbnails that a canvas draws: loaded a few at a time as they are needed, and kept up to a number.
(() => {
  const lpn = window.lpn;
  if (lpn.thumbnails) return;
  const LOADING = 6, KEPT = 400, RETRY = 3000;

  // `redraw` is called when a picture has come.
  lpn.thumbnails = (redraw) => {
    const images = new Map(); // by address, the oldest first
    let queue = [];
    const next = () => {
      let busy = [...images.values()].filter((one) => !one.complete).length;
      for (; busy < LOADING && queue.length; busy++) {
        const address = queue.shift(), image = new Image();
        images.set(address, image);
        image.onload = () => (redraw(), next());
        image.onerror = () => {
          setTimeout(() => images.delete(address), RETRY); // it is asked for again when it is drawn again
          next();
        };
        image.src = address;
      }
      for (const [address, image] of images) {
        if (images.size <= KEPT) break;
        if (image.complete) images.delete(address);
      }
    };
    return {
      // The pictures of these addresses, null for each that has not come yet; no others are loaded any more.
      all: (addresses) => {
        queue = addresses.filter((address) => !images.has(address));
        next();
        return addresses.map((address) => {
          const image = images.get(address);
          return image?.complete && image.naturalWidth ? image : null;
        });
      },
    };
  };
})();
