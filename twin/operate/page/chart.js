// A chart over time as SVG: bands, lines, marks of single readings, jumps, events and limits.
import { fixed } from './format.js';

const SPACE = 'http://www.w3.org/2000/svg';
const BANDS = [[1.96, 'wide-band'], [0.9945, 'narrow-band']]; // sigmas within which 95 and 68 % lie
const SEEN = 3; // a limit is drawn where it lies within so many times the reach of the course
const HOUR = 3600e6, DAY = 24 * HOUR; // microseconds
const STEPS = [HOUR, 3 * HOUR, 6 * HOUR, 12 * HOUR, DAY, 2 * DAY, 7 * DAY, 14 * DAY];
const MONTHS = [1, 2, 3, 6, 12, 24, 60];
const NAMES = ['Jan', 'Feb', 'Mar', 'Apr', 'May', 'Jun', 'Jul', 'Aug', 'Sep', 'Oct', 'Nov', 'Dec'];

const made = (name, attributes, text) => {
  const node = document.createElementNS(SPACE, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== undefined) node.textContent = text;
  return node;
};

// round numbers, three to six of them
const ticks = (low, high, few = 5) => {
  const rough = (high - low) / few;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((times) => times * power >= rough * 0.999);
  const out = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) out.push(k * step);
  return { at: out, places: Math.max(0, Math.min(9, -Math.floor(Math.log10(step) + 1e-9))) };
};

export class Chart {
  // offset: microseconds of the record's time minus those of POSIX time
  constructor(root, { log = false, picked = null, hovered = null } = {}) {
    Object.assign(this, { root, log, picked, hovered, told: null, offset: 0 });
    new ResizeObserver(() => this.draw()).observe(root);
    root.addEventListener('pointermove', (event) => hovered?.(this.timeAt(event)));
    root.addEventListener('pointerleave', () => hovered?.(null));
    root.addEventListener('click', (event) => { const time = this.timeAt(event); if (time !== null) picked?.(time); });
  }

  date(time) { return new Date((time - this.offset) / 1000); }

  timeAt(event) {
    if (!this.told) return null;
    const x = event.clientX - this.root.getBoundingClientRect().left;
    const share = (x - this.left) / (this.right - this.left);
    return share < 0 || share > 1 ? null : Math.round(this.told.from + share * (this.told.to - this.told.from));
  }

  show(told) {
    this.told = told;
    this.draw();
  }

  range() {
    const { courses, points, limit } = this.told;
    if (this.log) {
      const all = [...points.values, ...courses.flatMap(({ values }) => values)].filter((value) => value > 0);
      return [Math.min(...all) / 1.3, Math.max(...all) * 1.3];
    }
    const values = [];
    for (const { values: own, sigmas } of courses) {
      own.forEach((value, k) => { if (value !== null) values.push(value - 1.96 * (sigmas?.[k] ?? 0), value + 1.96 * (sigmas?.[k] ?? 0)); });
    }
    const single = points.values.filter((value) => value !== null).sort((a, b) => a - b);
    if (single.length) values.push(single[Math.floor(0.01 * single.length)], single[Math.ceil(0.99 * single.length) - 1]);
    let [low, high] = [Math.min(...values), Math.max(...values)];
    const reach = Math.max(Math.abs(low), Math.abs(high));
    if (limit && limit <= SEEN * reach) { low = Math.min(low, -limit); high = Math.max(high, limit); }
    if (!(high > low)) { low -= 1e-6; high += 1e-6; }
    const pad = 0.06 * (high - low);
    return [low - pad, high + pad];
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.root;
    const told = this.told;
    if (!told || !width || !height) return;
    const svg = made('svg', { viewBox: `0 0 ${width} ${height}`, width, height });
    if (!told.points.values.length && !told.courses.some(({ values }) => values.length)) {
      svg.append(made('text', { x: width / 2, y: height / 2, class: 'middle' }, 'nothing to show'));
      this.root.replaceChildren(svg);
      return;
    }
    const [low, high] = this.range();
    const scale = this.log ? Math.log10 : (value) => value;
    const [bottom, top] = [height - 22, 8];
    const marks = this.log ? this.decades(low, high) : ticks(low, high, height < 220 ? 4 : 6);
    const labels = marks.at.map((value) => (this.log ? String(Number(value.toPrecision(3))) : fixed(value, marks.places)));
    this.left = 12 + 6.6 * Math.max(...labels.map((label) => label.length), 3);
    this.right = width - 10;
    this.x = (time) => this.left + ((this.right - this.left) * (time - told.from)) / (told.to - told.from);
    this.y = (value) => bottom - ((bottom - top) * (scale(value) - scale(low))) / (scale(high) - scale(low));
    marks.at.forEach((value, k) => {
      svg.append(made('line', { x1: this.left, x2: this.right, y1: this.y(value), y2: this.y(value), class: 'grid' }));
      svg.append(made('text', { x: this.left - 5, y: this.y(value) + 4, class: 'end' }, labels[k]));
    });
    this.times(svg, bottom, top);
    const clip = made('clipPath', { id: `${this.root.id}-clip` });
    clip.append(made('rect', { x: this.left, y: top, width: this.right - this.left, height: bottom - top }));
    const inner = made('g', { 'clip-path': `url(#${this.root.id}-clip)` });
    svg.append(clip, inner);
    for (const { from, to, name } of told.jumps ?? []) {
      const x = this.x(from);
      const wide = Math.max(2, this.x(to) - x);
      const band = made('rect', { x: x - 1, y: top, width: wide, height: bottom - top, class: wide > 12 ? 'jump broad' : 'jump' });
      band.append(made('title', {}, name));
      inner.append(band);
    }
    for (const { at, name } of told.events ?? []) {
      const line = made('line', { x1: this.x(at), x2: this.x(at), y1: top, y2: bottom, class: 'event' });
      line.append(made('title', {}, name));
      inner.append(line);
    }
    this.courses(inner);
    this.points(inner);
    for (const value of told.limit ? [told.limit, -told.limit] : []) {
      inner.append(made('line', { x1: this.left, x2: this.right, y1: this.y(value), y2: this.y(value), class: 'limit' }));
    }
    if (told.chosen !== undefined && told.chosen !== null) {
      inner.append(made('line', { x1: this.x(told.chosen), x2: this.x(told.chosen), y1: top, y2: bottom, class: 'chosen' }));
    }
    this.root.replaceChildren(svg);
  }

  decades(low, high) {
    const at = [];
    const few = Math.log10(high / low) < 2;
    for (let power = Math.floor(Math.log10(low)); 10 ** power <= high; power += 1) {
      for (const times of few ? [1, 2, 5] : [1]) if (times * 10 ** power >= low && times * 10 ** power <= high) at.push(times * 10 ** power);
    }
    return { at };
  }

  // days, months or years, so many that their names have room
  times(svg, bottom, top) {
    const { from, to } = this.told;
    const room = Math.max(2, Math.floor((this.right - this.left) / 64));
    const step = STEPS.find((one) => (to - from) / one <= room);
    const at = [];
    if (step) {
      const first = Math.ceil((from - this.offset) / step) * step + this.offset;
      for (let time = first; time <= to; time += step) at.push(time);
    } else {
      const span = (to - from) / (30.44 * DAY);
      const months = MONTHS.find((one) => span / one <= room) ?? 120;
      const begin = this.date(from);
      let month = begin.getUTCFullYear() * 12 + begin.getUTCMonth();
      month = Math.ceil(month / months) * months;
      for (;; month += months) {
        const time = Date.UTC(Math.floor(month / 12), month % 12, 1) * 1000 + this.offset;
        if (time > to) break;
        if (time >= from) at.push(time);
      }
    }
    for (const time of at) {
      const date = this.date(time);
      const day = `${date.getUTCDate()} ${NAMES[date.getUTCMonth()]}`;
      let text = day;
      if (step && step < DAY) text = date.getUTCHours() ? `${String(date.getUTCHours()).padStart(2, '0')}:00` : day;
      else if (!step) text = date.getUTCMonth() ? `${NAMES[date.getUTCMonth()]} ${String(date.getUTCFullYear()).slice(2)}` : String(date.getUTCFullYear());
      const x = this.x(time);
      svg.append(made('line', { x1: x, x2: x, y1: bottom, y2: bottom + 4, class: 'tick' }));
      if (x > this.left + 14 && x < this.right - 14) svg.append(made('text', { x, y: bottom + 17, class: 'middle' }, text));
    }
    svg.append(made('line', { x1: this.left, x2: this.right, y1: bottom, y2: bottom, class: 'tick' }));
  }

  courses(inner) {
    const path = (points) => points.map(([x, y], k) => `${k ? 'L' : 'M'}${x.toFixed(1)} ${y.toFixed(1)}`).join('');
    for (const { times, values, sigmas, name } of this.told.courses) {
      const known = times.map((time, k) => k).filter((k) => values[k] !== null);
      for (const [many, width] of sigmas ? BANDS : []) {
        const side = (sign) => known.map((k) => [this.x(times[k]), this.y(values[k] + sign * many * sigmas[k])]);
        inner.append(made('path', { d: `${path([...side(1), ...side(-1).reverse()])}Z`, class: `${name} ${width}` }));
      }
      inner.append(made('path', { d: path(known.map((k) => [this.x(times[k]), this.y(values[k])])), class: `${name} line` }));
    }
  }

  points(inner) {
    const { times, values, sigmas, far } = this.told.points;
    const few = times.length <= 80;
    const group = made('g', { class: 'points' });
    times.forEach((time, k) => {
      if (values[k] === null || time < this.told.from || time > this.told.to) return;
      const [x, y] = [this.x(time).toFixed(1), this.y(values[k])];
      if (few && sigmas?.[k]) group.append(made('line', { x1: x, x2: x, y1: this.y(values[k] - sigmas[k]), y2: this.y(values[k] + sigmas[k]) }));
      group.append(made('circle', { cx: x, cy: y.toFixed(1), r: far?.[k] ? 3.2 : few ? 2.2 : 1.3, ...(far?.[k] ? { class: 'far' } : {}) }));
    });
    inner.append(group);
  }
}
