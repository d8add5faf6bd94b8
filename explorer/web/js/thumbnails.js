// Thumbnails that a canvas draws.
(() => {
  const lpn = window.lpn;
  if (lpn.thumbnails) return;
  const KEPT = 400;

  // `redraw` is called when a picture has come.
  lpn.thumbnails = (redraw) => {
    const loader = lpn.pictureLoader(redraw, KEPT);
    return {
      // The pictures of these addresses, null for each that has not come yet; no others are loaded any more.
      all: (addresses) => {
        const found = addresses.map(loader.image);
        loader.request(addresses.filter((_, i) => !found[i]));
        return found;
      },
    };
  };
})();
