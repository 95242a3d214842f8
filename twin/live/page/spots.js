// The spots as the area CCDs see them, and the centroids that were measured in them.
const byId = (id) => document.getElementById(id);
const CROP = 28; // pixels across the view of a spot
const LARGEST = 9; // px of the drawn ellipse's longer half axis, to which all are enlarged alike

export class Spots {
  constructor() {
    this.images = {};
    this.told = null;
    this.blind = false;
    this.figures = [];
  }

  build(hello) {
    this.hello = hello;
    this.images = {};
    this.told = null;
    const make = (tag, className) => Object.assign(document.createElement(tag), { className });
    this.figures = hello.channels.map(({ key, camera, name }) => {
      const figure = document.createElement('figure');
      const stack = make('div', 'stack');
      const image = Object.assign(make('canvas', 'image'), { width: hello.columns, height: hello.rows });
      image.dataset.channel = key;
      image.setAttribute('role', 'img');
      image.setAttribute('aria-label', `spot of channel ${key}`);
      const marks = make('canvas', 'marks');
      const caption = document.createElement('figcaption');
      const told = Object.assign(document.createElement('span'), { textContent: 'row … px\ncolumn … px' });
      caption.append(Object.assign(document.createElement('b'), { textContent: key.replaceAll('/', ' ') }), told);
      stack.append(image, marks);
      figure.append(stack, caption);
      return { camera, name, figure, image, marks, told, pixels: new ImageData(hello.columns, hello.rows) };
    });
    byId('spots').replaceChildren(...this.figures.map(({ figure }) => figure));
  }

  take(told, images) {
    if (!told.problem) this.told = told;
    for (const [name, image] of Object.entries(images)) this.images[name] = image;
  }

  draw() {
    const { after, before, guess } = this.images;
    if (!before || !this.told || !this.figures.length) return;
    const show = byId('show').value;
    const first = show === 'before' || !after ? before : show === 'guess' && guess ? guess : after;
    const second = show === 'difference' ? (this.blind && guess ? guess : before) : null;
    const shade = second ? this.difference(after ?? before, second) : this.grey(before);
    const enlarged = this.enlargement();
    this.figures.forEach((figure, channel) => {
      const size = first.rows * first.columns;
      const offset = channel * size;
      const data = figure.pixels.data;
      for (let k = 0; k < size; k += 1) {
        const colour = shade(first.pixels[offset + k], second ? second.pixels[offset + k] : 0);
        data[4 * k] = colour[0];
        data[4 * k + 1] = colour[1];
        data[4 * k + 2] = colour[2];
        data[4 * k + 3] = 255;
      }
      this.put(figure, enlarged);
    });
    byId('spots-caption').textContent = `${byId('noise').checked ? 'The first frame' : 'The expected image'} of each CCD. `
      + (second ? `${this.blind ? 'After − your guess' : 'After − before'}, red is more light. ` : '')
      + `Crosses: ${this.blind && this.told.guess ? 'hidden (orange) and your guess (blue)' : 'before (blue) and after (orange)'}`
      + (enlarged ? `; ellipses: 1 σ of the centroid, ×${Number(enlarged.toPrecision(2)).toLocaleString('en')}.` : '.');
  }

  // black level to the brightest pixel before: what dims or spreads is seen to
  grey(before) {
    let top = 0;
    for (const value of before.pixels) top = Math.max(top, value);
    const floor = this.hello.offset;
    const stretch = byId('stretch').value;
    const shades = new Map();
    return (value) => {
      let shade = shades.get(value);
      if (shade === undefined) {
        const share = Math.min(1, Math.max(0, (value - floor) / Math.max(1, top - floor)));
        const bent = stretch === 'root' ? Math.sqrt(share) : stretch === 'log' ? Math.log1p(1000 * share) / Math.log(1001) : share;
        const level = Math.round(255 * bent);
        shade = [level, level, level];
        shades.set(value, shade);
      }
      return shade;
    };
  }

  difference(after, before) {
    let most = 1;
    for (let k = 0; k < after.pixels.length; k += 1) most = Math.max(most, Math.abs(after.pixels[k] - before.pixels[k]));
    const bend = { linear: (x) => x, root: Math.sqrt, log: (x) => Math.log1p(1000 * x) / Math.log(1001) }[byId('stretch').value];
    return (value, other) => {
      const share = (value - other) / most;
      const level = Math.round(255 * (1 - bend(Math.abs(share))));
      return share >= 0 ? [255, level, level] : [level, level, 255];
    };
  }

  spot(channel, when) {
    const { camera, name } = this.figures[channel];
    return this.told.readings.spots[camera][name][when];
  }

  // one factor for all ellipses, so that they can be compared
  enlargement() {
    if (!byId('marks').checked || this.told.problem) return 0;
    let most = 0;
    this.figures.forEach((_, channel) => {
      const { row_sigma: row, column_sigma: column } = this.spot(channel, 'after');
      most = Math.max(most, row, column);
    });
    const cropped = byId('crop').value === 'spot' ? CROP / this.hello.columns : 1;
    return most > 0 ? (LARGEST * cropped) / most : 0;
  }

  put(figure, enlarged) {
    const channel = this.figures.indexOf(figure);
    const before = this.spot(channel, 'before');
    const after = this.spot(channel, 'after');
    const { rows, columns } = this.hello;
    const whole = byId('crop').value === 'whole';
    const middle = whole ? [(rows - 1) / 2, (columns - 1) / 2] : [Math.round(after.row), Math.round(after.column)];
    const across = whole ? columns : CROP;
    const left = middle[1] - (across - 1) / 2;
    const top = middle[0] - (across - 1) / 2;
    const image = figure.image.getContext('2d', { willReadFrequently: true });
    const side = whole ? columns : CROP;
    if (figure.image.width !== side) { figure.image.width = side; figure.image.height = whole ? rows : CROP; }
    image.putImageData(figure.pixels, whole ? 0 : -Math.ceil(left), whole ? 0 : -Math.ceil(top));
    const shift = [after.row - before.row, after.column - before.column];
    const px = (value) => `${value < 0 ? '−' : '+'}${Math.abs(value).toFixed(4)}`;
    figure.told.textContent = `row ${px(shift[0])} px\ncolumn ${px(shift[1])} px`;
    const marks = figure.marks;
    const size = Math.round(marks.clientWidth * (window.devicePixelRatio || 1)) || 150;
    if (marks.width !== size) { marks.width = size; marks.height = size; }
    const pen = marks.getContext('2d', { willReadFrequently: true });
    pen.clearRect(0, 0, size, size);
    if (!byId('marks').checked || this.told.problem) return;
    const scale = size / across;
    const shown = whole ? [0, 0] : [Math.ceil(top), Math.ceil(left)];
    const at = ({ row, column }) => [(column - shown[1] + 0.5) * scale, (row - shown[0] + 0.5) * scale];
    const guess = this.blind && this.told.guess?.spots ? this.told.guess.spots[channel] : null;
    this.cross(pen, at(guess ? { row: guess[0], column: guess[1] } : before), '#56b4e9', 7);
    this.cross(pen, at(after), '#ff7f2a', 5);
    if (enlarged) {
      pen.strokeStyle = '#ff7f2a';
      pen.beginPath();
      pen.ellipse(...at(after), enlarged * after.column_sigma * scale, enlarged * after.row_sigma * scale, 0, 0, 2 * Math.PI);
      pen.stroke();
    }
  }

  cross(pen, [x, y], colour, arm) {
    const extent = arm * (window.devicePixelRatio || 1);
    pen.strokeStyle = colour;
    pen.lineWidth = 1.4 * (window.devicePixelRatio || 1);
    pen.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      pen.moveTo(x + 0.35 * extent * dx, y + 0.35 * extent * dy);
      pen.lineTo(x + 1.5 * extent * dx, y + 1.5 * extent * dy);
    }
    pen.stroke();
  }
}
