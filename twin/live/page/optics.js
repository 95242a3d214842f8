// The optics of a single camera at its field point: layout, wavefront, spot, point image and MTF, on canvases.
import { fixed } from './format.js';

const byId = (id) => document.getElementById(id);
const NAMES = ['layout', 'wavefront', 'spot', 'psf', 'mtf'];
const DARK = 65535;

export class Optics {
  constructor() {
    this.figures = new Map();
    this.images = {};
    new ResizeObserver(() => this.draw()).observe(byId('optics'));
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.draw());
  }

  build(hello) {
    byId('optics').hidden = !hello.design;
    if (this.figures.size) return;
    for (const name of NAMES) {
      const [figure, canvas, caption] = ['figure', 'canvas', 'figcaption'].map((tag) => document.createElement(tag));
      figure.id = `optics-${name}`;
      canvas.setAttribute('role', 'img');
      figure.append(canvas, caption);
      byId('optics').append(figure);
      this.figures.set(name, { figure, canvas, caption });
    }
  }

  take(told, images) {
    if (!told.optics) return;
    this.told = { ...this.told };
    for (const name of NAMES) {
      const { figure, caption } = this.figures.get(name);
      const { problem } = told.optics[name];
      figure.classList.toggle('stale', Boolean(problem));
      if (problem) { caption.textContent = problem; continue; }
      this.told[name] = told.optics[name];
      if (images[name]) this.images[name] = images[name];
      caption.textContent = this.caption(name, told.optics);
      this.figures.get(name).canvas.setAttribute('aria-label', `${name}: ${caption.textContent}`);
    }
  }

  caption(name, { layout, wavefront, spot, psf, mtf, field_deg: field }) {
    const point = field.map((angle) => `${fixed(angle, 3)}°`).join(', ');
    switch (name) {
      case 'layout': return `Section: f ${fixed(layout.focal_length_m, 4)} m, F/${fixed(layout.f_number, 2)}; orange: field ${point}, grey: ends along the track`;
      case 'wavefront': return `Wavefront: ${fixed(wavefront.rms_waves, 4)} waves rms, ${fixed(wavefront.peak_to_valley_waves, 3)} PV at ${fixed(wavefront.wavelength_nm, 0)} nm`;
      case 'spot': return `Spot: rms radius ${fixed(spot.rms_um, 2)} µm; box ${fixed(2 * spot.half_um, 1)} µm, circle: Airy disk`;
      case 'psf': return `PSF, root of the light: Strehl ${fixed(psf.strehl, 3)}; box ${fixed(2 * psf.half_um, 1)} µm`;
      default: return `MTF at Nyquist: ${fixed(mtf.along, 3)} along the line (blue), ${fixed(mtf.across, 3)} along the track (orange)`;
    }
  }

  draw() {
    const style = getComputedStyle(document.documentElement);
    this.colour = Object.fromEntries(['ink', 'soft', 'line', 'paper', 'before', 'after'].map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
    for (const name of Object.keys(this.told ?? {})) {
      const { canvas } = this.figures.get(name);
      const ratio = window.devicePixelRatio || 1;
      const [width, height] = [canvas.clientWidth, canvas.clientHeight];
      if (!width) continue;
      Object.assign(canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
      const pen = canvas.getContext('2d');
      pen.scale(ratio, ratio);
      pen.font = '11px system-ui, sans-serif';
      this[name](pen, this.told[name], width, height);
    }
  }

  // --- pictures of pixels, with the first row at the bottom ----------------------------------------------------------
  pixels(pen, { columns, rows, pixels }, side, shade) {
    const small = new OffscreenCanvas(columns, rows);
    const data = new ImageData(columns, rows);
    pixels.forEach((value, k) => data.data.set(shade(value), 4 * ((rows - 1 - Math.floor(k / columns)) * columns + (k % columns))));
    small.getContext('2d').putImageData(data, 0, 0);
    pen.imageSmoothingEnabled = false;
    pen.drawImage(small, 0, 0, side, side);
  }

  rgb(name) {
    const pen = new OffscreenCanvas(1, 1).getContext('2d');
    pen.fillStyle = this.colour[name];
    pen.fillRect(0, 0, 1, 1);
    return [...pen.getImageData(0, 0, 1, 1).data.slice(0, 3)];
  }

  wavefront(pen, told, width) {
    const [low, middle, high] = ['before', 'paper', 'after'].map((name) => this.rgb(name));
    this.pixels(pen, this.images.wavefront, width, (value) => {
      const share = (value - 1) / 32767 - 1;
      return value ? [...middle.map((part, k) => part + Math.abs(share) * ((share < 0 ? low : high)[k] - part)), 255] : [0, 0, 0, 0];
    });
    this.circle(pen, width / 2, width / 2, this.colour.soft);
    pen.fillStyle = this.colour.soft;
    pen.fillText(`±${Number(told.scale_waves.toPrecision(2))} waves`, 2, 11);
  }

  psf(pen, told, width) {
    this.pixels(pen, this.images.psf, width, (value) => {
      const level = 255 * Math.sqrt(value / DARK);
      return [level, level, level, 255];
    });
  }

  circle(pen, middle, radius, colour) {
    pen.strokeStyle = colour;
    pen.beginPath();
    pen.arc(middle, middle, Math.max(0, radius - 0.5), 0, 2 * Math.PI);
    pen.stroke();
  }

  // --- pictures of points and lines -----------------------------------------------------------------------------------
  spot(pen, told, width) {
    const scale = width / (2 * told.half_um);
    this.circle(pen, width / 2, told.airy_um * scale, this.colour.soft);
    pen.fillStyle = this.colour.before;
    for (const [x, y] of told.rays_um) pen.fillRect(width / 2 + x * scale - 1, width / 2 - y * scale - 1, 2, 2);
  }

  line(pen, points, colour, thick = 1, dash = []) {
    Object.assign(pen, { strokeStyle: colour, lineWidth: thick });
    pen.setLineDash(dash);
    pen.beginPath();
    points.forEach(([x, y]) => pen.lineTo(x, y));
    pen.stroke();
  }

  mtf(pen, told, width, height) {
    const [left, bottom, end] = [28, height - 16, told.frequency.at(-1)];
    const at = (frequency, value) => [left + ((width - left - 4) * frequency) / end, bottom - (bottom - 6) * value];
    pen.fillStyle = this.colour.soft;
    for (const value of [0, 0.5, 1]) {
      this.line(pen, [at(0, value), at(end, value)], this.colour.line);
      pen.fillText(String(value), 4, at(0, value)[1] + 4);
    }
    this.line(pen, [at(end / 2, 0), at(end / 2, 1)], this.colour.line);
    pen.textAlign = 'center';
    pen.fillText(`Nyquist ${fixed(end / 2, 1)} cycles/mm`, at(end / 2, 0)[0], height - 4);
    const curve = (values) => values.map((value, k) => at(told.frequency[k], value));
    told.limit.forEach((values) => this.line(pen, curve(values), this.colour.soft, 1, [4, 3]));
    told.values.forEach((values, k) => this.line(pen, curve(values), [this.colour.before, this.colour.after][k], 1.6));
  }

  layout(pen, told, width, height) {
    const all = [...told.surfaces.flatMap(({ points }) => points), ...told.rays.flat(2)];
    const [z, y] = [0, 1].map((axis) => all.map((point) => point[axis]));
    const [low, high] = [[Math.min(...z), Math.min(...y)], [Math.max(...z), Math.max(...y)]];
    const scale = Math.min((width - 50) / (high[0] - low[0]), (height - 30) / (high[1] - low[1]));
    const at = ([a, b]) => [width / 2 + scale * (a - (low[0] + high[0]) / 2), height / 2 - scale * (b - (low[1] + high[1]) / 2)];
    told.rays.forEach((rays, field) => rays.forEach((ray, k) => {
      this.line(pen, ray.map(at), field < 2 ? this.colour.soft : this.colour.after, field < 2 ? 0.6 : 1, k ? [] : [5, 2]);
    }));
    pen.fillStyle = this.colour.ink;
    pen.textAlign = 'center';
    const taken = []; // names stand clear of each other, above and below by turns
    for (const { name, passes, points } of told.surfaces) {
      this.line(pen, points.map(at), passes ? this.colour.soft : this.colour.ink, passes ? 1 : 2.5, passes ? [1, 2] : []);
      const half = pen.measureText(name).width / 2 + 2;
      let row = 0;
      const end = () => at(points.reduce((a, b) => (b[1] > a[1] === (row % 2 === 0) ? b : a)));
      while (taken.some(([x, size, used]) => used === row && Math.abs(x - end()[0]) < size + half)) row += 1;
      taken.push([end()[0], half, row]);
      pen.fillText(name, end()[0], end()[1] + (row % 2 ? 12 : -4) + (row % 2 ? 13 : -13) * Math.floor(row / 2));
    }
  }
}
