// The images of the cameras: small ones below the scene, in the order of the data.

class PhotoStrip {
  constructor(element, names) {
    this.element = element;
    this.images = new Map(names.map((name) => [name, make('img', { alt: `Image of ${name}`, title: name })]));
    element.append(...this.images.values());
  }

  setVisible(visible) {
    this.element.hidden = !visible || this.images.size === 0;
  }

  /** Shows the images of a frame: the bytes of a JPEG for each camera that has one. */
  show(photos) {
    for (const [name, image] of this.images) {
      image.hidden = !photos[name];
      if (photos[name]) image.src = `data:image/jpeg;base64,${toBase64(photos[name])}`;
    }
  }
}

/** Returns bytes as text; in pieces, because a call takes a limited number of arguments. */
function toBase64(bytes) {
  let text = '';
  for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
}
