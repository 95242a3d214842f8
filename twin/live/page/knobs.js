// The knobs: a tree of bodies, a slider for each number, the course's times, a study's factors.
import { check, readNumber, stepped } from './numbers.js';

const byId = (id) => document.getElementById(id);
const element = (tag, properties = {}, ...children) => {
  const out = Object.assign(document.createElement(tag), properties);
  out.append(...children);
  return out;
};
const field = (properties = {}) => element('input', { type: 'text', className: 'number', inputMode: 'decimal', autocomplete: 'off', ...properties });
const NAMES = { rotate: 'rotate', shift: 'shift', figure: 'figure', scale: 'scale', temperature: 'temperature', gradient: 'gradient', design: '', field: '' };
// the number as the slider steps it, without the tail of a binary fraction
const tidy = (value, step) => Number(value.toFixed(Math.max(0, Math.min(12, 2 - Math.floor(Math.log10(step))))));

class Row {
  // a slider, a number and what belongs to it; `take` is called with every value
  constructor({ label, unit, value, extent, low, limit, long }, take, done) {
    this.value = value;
    this.take = take;
    const low_ = low ?? -extent;
    this.step = (extent - low_) / 1000;
    this.slider = element('input', { type: 'range' });
    this.slider.setAttribute('aria-label', `${label} in ${unit || 'units'}`);
    this.number = field();
    stepped(this.number, () => this.step, (value) => tidy(value, this.step));
    this.number.setAttribute('aria-label', `${label} in ${unit || 'units'}, as a number`);
    const reset = element('button', { textContent: '↺', title: 'reset to the initial value' });
    const more = element('button', { textContent: '…', title: 'range and step' });
    [this.low, this.high, this.steps] = [field(), field(), field()];
    this.ends = element('div', { className: 'ends', hidden: true },
      element('label', {}, 'from ', this.low), element('label', {}, 'to ', this.high), element('label', {}, 'step ', this.steps));
    const name = element('span', { className: 'label', title: `${label} [${unit}]` }, label.split(' ').slice(long ? 0 : 1).join(' ') || label, ' ', element('small', {}, unit.replace('percent', '%')));
    this.box = element('div', { className: long ? 'knob long' : 'knob' }, name, this.slider, this.number, reset, more, this.ends);
    this.first = value;
    this.range(low_, extent, this.step);
    this.show(value);
    this.slider.addEventListener('input', () => this.turn(tidy(Number(this.slider.value), this.step)));
    this.slider.addEventListener('change', done);
    this.number.addEventListener('input', () => {
      const typed = readNumber(this.number.value);
      if (check(this.number, Number.isFinite(typed) && !(limit && Math.abs(typed) > limit))) this.turn(typed, true);
    });
    this.number.addEventListener('change', () => { check(this.number, true); this.show(this.value); done(); });
    reset.addEventListener('click', () => { this.turn(this.first); done(); });
    more.addEventListener('click', () => { this.ends.hidden = !this.ends.hidden; });
    for (const end of [this.low, this.high, this.steps]) {
      end.addEventListener('change', () => {
        const [a, b, s] = [this.low, this.high, this.steps].map((input) => readNumber(input.value));
        if (check(end, a < b && s > 0)) this.range(a, b, s);
      });
    }
  }

  range(low, high, step) {
    this.step = step;
    Object.assign(this.slider, { min: low, max: high, step });
    this.slider.value = this.value;
    Object.assign(this.low, { value: low });
    Object.assign(this.high, { value: high });
    this.steps.value = step;
  }

  turn(value, typed = false) {
    this.show(value, typed);
    this.take(value);
  }

  show(value, typed = false) {
    this.value = value;
    if (value < Number(this.slider.min) || value > Number(this.slider.max)) {
      const end = 1.2 * Math.abs(value);
      this.range(Math.min(Number(this.slider.min), -end), Math.max(Number(this.slider.max), end), this.step);
    }
    this.slider.value = value;
    if (!typed) this.number.value = value;
    this.box.classList.toggle('set', value !== 0);
  }
}

export class Knobs {
  constructor(root, changed, settled, build) {
    Object.assign(this, { root, changed, rebuild: build, knobs: {}, pivots: {}, rows: new Map(), time: null });
    this.settled = () => { this.list(); settled(); };
    byId('filter').addEventListener('input', () => this.filter());
    byId('time').addEventListener('input', () => this.goTo(Number(byId('time').value)));
    byId('play').addEventListener('click', () => this.play());
  }

  // --- values ------------------------------------------------------------------------------------------------------
  values() {
    return { knobs: { ...this.knobs }, pivots: { ...this.pivots }, time: this.time };
  }

  set({ knobs, pivots, time }) {
    this.knobs = Object.fromEntries(Object.entries(knobs).filter(([name]) => this.known.has(name)));
    this.pivots = { ...pivots };
    for (const [name, rows] of this.rows) for (const row of rows) row.show(this.knobs[name] ?? 0);
    for (const [node, select] of this.pivotSelects) select.value = this.pivots[node] ?? 'origin';
    if (time !== null && this.course) this.goTo(time, false);
    this.counts();
    this.list();
  }

  reset() {
    this.set({ ...this.first, time: this.time });
  }

  turn(name, value) {
    if (value === 0) delete this.knobs[name]; else this.knobs[name] = value;
    for (const row of this.rows.get(name) ?? []) if (row.value !== value) row.show(value);
    this.counts();
    this.changed();
  }

  // --- the tree ----------------------------------------------------------------------------------------------------
  build(hello, values) {
    const open = new Set([...this.root.querySelectorAll('#tree details[open]')].map((node) => node.dataset.path));
    this.rows = new Map();
    this.pivotSelects = new Map();
    this.known = new Map(hello.knobs.map((knob) => [knob.name, knob]));
    this.nodes = hello.nodes;
    this.course = hello.course;
    this.time = hello.course ? hello.course.shown : null;
    this.first = {
      knobs: Object.fromEntries(hello.knobs.filter((knob) => knob.value !== 0).map((knob) => [knob.name, knob.value])),
      pivots: Object.fromEntries(Object.entries(hello.nodes).filter(([, node]) => node.pivot !== 'origin')
        .map(([path, node]) => [path, node.pivot])),
    };
    this.knobs = { ...this.first.knobs };
    this.pivots = { ...this.first.pivots };
    this.byNode = Map.groupBy ? Map.groupBy(hello.knobs, (knob) => knob.node) : this.grouped(hello.knobs);
    const tree = byId('tree');
    tree.replaceChildren();
    const boxes = new Map();
    for (const path of Object.keys(hello.nodes)) {
      const parent = boxes.get(path.slice(0, path.lastIndexOf('/'))) ?? this.parentOf(path, boxes) ?? tree;
      const short = parent === tree ? path : path.slice(parent.dataset.path.length + 1);
      const box = element('details', {}, element('summary', {}, short, ' ', element('span', { className: 'count' })));
      box.dataset.path = path;
      box.addEventListener('toggle', () => this.fill(box));
      boxes.set(path, box);
      parent.append(box);
      if (open.has(path) || path.split('/').length < 2) box.open = true;
    }
    this.boxes = boxes;
    this.buildCourse();
    this.buildFactors(hello.factors ?? []);
    this.movedShown = '';
    if (values) this.set(values);
    this.counts();
    this.list();
  }

  grouped(knobs) {
    const out = new Map();
    for (const knob of knobs) out.set(knob.node, [...(out.get(knob.node) ?? []), knob]);
    return out;
  }

  // the nearest body above that has a node of its own
  parentOf(path, boxes) {
    let above = path;
    while (above.includes('/')) {
      above = above.slice(0, above.lastIndexOf('/'));
      if (boxes.has(above)) return boxes.get(above);
    }
    return null;
  }

  fill(box) {
    if (!box.open || box.dataset.filled) return;
    box.dataset.filled = 'yes';
    const node = box.dataset.path;
    const list = element('div', { className: 'list' });
    let kind = '';
    for (const knob of this.byNode.get(node) ?? []) {
      if (knob.kind !== kind) {
        kind = knob.kind;
        const head = element('h3', {}, NAMES[kind]);
        if (kind === 'rotate' && this.nodes[node].pivots.length > 1) head.append(' about ', this.pivot(node));
        if (NAMES[kind]) list.append(head);
      }
      list.append(this.row(knob).box);
    }
    box.querySelector('summary').after(list);
  }

  row(knob, long = false) {
    const label = long ? knob.name.replace(/^base\//, '') : `${knob.node} ${knob.axis || { scale: 'growth', temperature: 'change' }[knob.kind]}`;
    const row = new Row(
      { label, unit: knob.unit, value: this.knobs[knob.name] ?? 0, extent: knob.extent, limit: knob.limit, long },
      (value) => this.turn(knob.name, value), () => this.settled());
    row.first = this.first.knobs[knob.name] ?? 0;
    row.box.dataset.knob = knob.name;
    this.rows.set(knob.name, [...(this.rows.get(knob.name) ?? []), row]);
    return row;
  }

  pivot(node) {
    const select = element('select', {}, ...this.nodes[node].pivots.map((name) => new Option(name, name)));
    select.setAttribute('aria-label', `point about which ${node} turns`);
    select.value = this.pivots[node] ?? 'origin';
    select.addEventListener('input', () => {
      if (select.value === 'origin') delete this.pivots[node]; else this.pivots[node] = select.value;
      this.changed();
      this.settled();
    });
    this.pivotSelects.set(node, select);
    return select;
  }

  // how many knobs are off zero, at each body and those it carries
  counts() {
    const by = new Map();
    for (const name of Object.keys(this.knobs)) {
      let path = this.known.get(name).node;
      for (;;) {
        by.set(path, (by.get(path) ?? 0) + 1);
        if (!path.includes('/')) break;
        path = path.slice(0, path.lastIndexOf('/'));
      }
    }
    for (const [path, box] of this.boxes) box.querySelector('.count').textContent = by.get(path) ? `(${by.get(path)})` : '';
  }

  // the list of those that are off zero; not while one is dragged, or it would move away under the pointer
  list() {
    const names = Object.keys(this.knobs).slice(0, 12);
    const shown = names.join();
    if (shown === this.movedShown || this.root.querySelector('#moved .list')?.contains(document.activeElement)) return;
    this.movedShown = shown;
    const list = this.root.querySelector('#moved .list');
    for (const [name, rows] of this.rows) this.rows.set(name, rows.filter((row) => !list.contains(row.box)));
    list.replaceChildren(...names.map((name) => this.row(this.known.get(name), true).box));
    byId('moved').hidden = !names.length;
  }

  // what fits is opened, and what leads to it without its own knobs
  filter() {
    const words = byId('filter').value.toLowerCase().split(/\s+/).filter(Boolean);
    if (words.length && !this.opened) this.opened = new Set([...this.boxes.keys()].filter((path) => this.boxes.get(path).open));
    const all = (path) => words.every((word) => path.toLowerCase().includes(word));
    // a word of a body's own name, and not of those that carry it alone
    const own = (path) => all(path) && words.some((word) => path.slice(path.lastIndexOf('/') + 1).toLowerCase().includes(word));
    const fitting = [...this.boxes.keys()].filter(own);
    for (const [path, box] of this.boxes) {
      const fits = fitting.includes(path);
      const way = !fits && fitting.some((other) => other.startsWith(`${path}/`));
      const carried = fitting.some((other) => path.startsWith(`${other}/`));
      box.hidden = words.length > 0 && !fits && !way && !carried;
      box.classList.toggle('way', words.length > 0 && way);
      if (words.length) box.open = fits || way;
      else if (this.opened) box.open = this.opened.has(path);
    }
    if (!words.length) this.opened = null;
  }

  // --- the course --------------------------------------------------------------------------------------------------
  buildCourse() {
    clearInterval(this.timer);
    byId('course').hidden = !this.course;
    if (!this.course) return;
    byId('time').max = this.course.times.length - 1;
    this.goTo(this.time, false);
  }

  goTo(k, ask = true) {
    this.time = k;
    byId('time').value = k;
    byId('time-name').value = this.course.names[k];
    if (ask) this.changed();
  }

  play() {
    const on = byId('play').getAttribute('aria-pressed') !== 'true';
    byId('play').setAttribute('aria-pressed', on);
    byId('play').textContent = on ? 'Pause' : 'Play';
    clearTimeout(this.timer);
    const step = () => {
      this.goTo((this.time + 1) % this.course.times.length);
      this.timer = setTimeout(step, 1000 / Math.min(30, Math.max(0.5, readNumber(byId('speed').value) || 4)));
    };
    if (on) step();
  }

  // --- a study's factors -------------------------------------------------------------------------------------------
  buildFactors(factors) {
    byId('factors').hidden = !factors.length;
    this.factorValues = Object.fromEntries(factors.filter((f) => f.now !== f.value).map((f) => [f.name, f.now]));
    const list = byId('factors').querySelector('.list');
    list.replaceChildren(...factors.map((factor) => {
      const names = Object.entries(factor.knobs).filter(([name]) => this.known.has(name));
      const take = names.length
        ? (value) => { for (const [name, ratio] of names) this.turn(name, value * ratio); }
        : (value) => { this.pending = { ...this.factorValues, [factor.name]: value }; };
      const done = () => {
        this.settled();
        if (!names.length && this.pending) { this.rebuild(this.pending); this.pending = null; }
      };
      const now = names.length ? (this.knobs[names[0][0]] ?? 0) / names[0][1] : factor.now;
      const row = new Row({ label: factor.name, unit: factor.unit, value: now, extent: factor.high, low: factor.low, long: true }, take, done);
      row.first = factor.value;
      if (factor.whole) row.range(factor.low, factor.high, 1);
      return row.box;
    }));
  }
}
