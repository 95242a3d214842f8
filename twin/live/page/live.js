// The page of the live twin: what it asks for, what it is told, and what the user did.
import { Knobs } from './knobs.js';
import { check, readNumber, stepped } from './numbers.js';
import { Spots } from './spots.js';
import { Optics } from './optics.js';
import { Readings } from './readings.js';
import { Scene } from './scene.js';

const byId = (id) => document.getElementById(id);
const IN_FLIGHT = 2; // states that are asked for at once: one is computed while the other waits its turn
const MOST_UNDO = 200;
const AFTER_QUIET = 350; // ms without a change before a picture is asked for
const SLOW = 2000; // ms without an answer, after which that is said

class Live {
  constructor() {
    this.hello = null;
    this.ws = null;
    this.n = 0;
    this.waiting = new Map(); // number of a state -> when it was asked for
    this.dirty = false;
    this.touched = 0;
    this.wait = 500;
    this.undo = [];
    this.redo = [];
    this.snapshot = null;
    this.blind = false;
    this.latencies = []; // for whoever measures: ms from the touch to the painted answer
    this.last = null; // the last answer
    this.shown = 0; // number of the last state that was painted
    this.paints = [];
    this.knobs = new Knobs(byId('knobs'), () => this.changed(), () => this.settled(), (values) => this.build(values));
    this.spots = new Spots();
    this.readings = new Readings();
    this.optics = new Optics();
    this.scene = new Scene(byId('scene'));
    this.listen();
    this.connect();
    setInterval(() => this.silence(), 500);
  }

  // --- what the user does ------------------------------------------------------------------------------------------
  listen() {
    for (const id of ['noise', 'frames', 'seed']) byId(id).addEventListener('input', () => this.changed());
    for (const id of ['frames', 'seed']) stepped(byId(id), () => 1);
    stepped(byId('speed'), () => 0.5);
    for (const id of ['show', 'stretch', 'crop', 'marks']) byId(id).addEventListener('input', () => this.spots.draw());
    byId('undo').addEventListener('click', () => this.travel(this.undo, this.redo));
    byId('redo').addEventListener('click', () => this.travel(this.redo, this.undo));
    byId('reset').addEventListener('click', () => { this.knobs.reset(); this.changed(); this.settled(); });
    byId('blind').addEventListener('click', () => this.say({ type: 'blind', on: !this.blind }));
    byId('record').addEventListener('click', () => {
      this.say({ type: 'record', on: byId('record').getAttribute('aria-pressed') !== 'true' });
    });
    byId('save-job').addEventListener('click', () => this.say({ type: 'save', what: 'job', state: this.state() }));
    byId('save-camera').addEventListener('click', () => this.say({ type: 'save', what: 'camera', state: this.state() }));
    byId('save-course').addEventListener('click', () => this.say({ type: 'save', what: 'course', state: this.state() }));
    for (const id of ['view-camera', 'view-what', 'view-field']) {
      byId(id).addEventListener('input', () => { this.askedView = ''; this.askView(); });
    }
    document.addEventListener('keydown', (event) => {
      if (!(event.ctrlKey || event.metaKey) || event.target.matches('input[type=search]')) return;
      const back = event.key === 'z' && !event.shiftKey;
      const forth = (event.key === 'Z' && event.shiftKey) || event.key === 'y';
      if (!back && !forth) return;
      event.preventDefault();
      if (back) this.travel(this.undo, this.redo); else this.travel(this.redo, this.undo);
    });
  }

  changed() {
    clearTimeout(this.rest);
    this.resting = false;
    if (!this.touched) this.touched = performance.now();
    this.dirty = true;
    this.ask();
  }

  // a drag ended: a step that can be undone
  settled() {
    const now = JSON.stringify(this.knobs.values());
    if (now === this.snapshot) return;
    if (this.snapshot !== null) this.undo.push(this.snapshot);
    if (this.undo.length > MOST_UNDO) this.undo.shift();
    this.redo.length = 0;
    this.snapshot = now;
    this.buttons();
  }

  travel(from, to) {
    if (!from.length) return;
    to.push(this.snapshot);
    this.snapshot = from.pop();
    this.knobs.set(JSON.parse(this.snapshot));
    this.changed();
    this.buttons();
  }

  buttons() {
    byId('undo').disabled = !this.undo.length;
    byId('redo').disabled = !this.redo.length;
  }

  // --- what is asked for -------------------------------------------------------------------------------------------
  state() {
    const whole = (id, low, high, otherwise) => {
      const value = readNumber(byId(id).value);
      return check(byId(id), Number.isInteger(value) && value >= low && value <= high) ? value : otherwise;
    };
    const { knobs, pivots, time } = this.knobs.values();
    return {
      type: 'state', n: this.n, t: this.touched, knobs, pivots, noise: byId('noise').checked,
      frames: whole('frames', 1, 64, this.hello.frames), seed: whole('seed', 0, 9007199254740991, this.hello.seed), time,
      quality: this.resting || !this.hello.design,
    };
  }

  ask() {
    if (!this.dirty || !this.hello || this.waiting.size >= IN_FLIGHT || this.ws?.readyState !== WebSocket.OPEN) return;
    this.dirty = false;
    this.n += 1;
    const state = this.state();
    this.waiting.set(state.n, performance.now());
    this.touched = 0;
    this.say(state);
  }

  askView() {
    clearTimeout(this.viewTimer);
    byId('view-field-value').value = byId('view-field').value;
    this.viewTimer = setTimeout(() => {
      const view = byId('view-what').value;
      if (!view) { byId('picture').hidden = true; byId('picture-problem').textContent = ''; return; }
      const asked = { view, camera: byId('view-camera').value, field: Number(byId('view-field').value) };
      const state = { ...this.state(), n: 0, t: 0 };
      const key = JSON.stringify([asked, state]);
      if (key === this.askedView || this.dirty || this.waiting.size) return;
      this.askedView = key;
      byId('picture-problem').textContent = 'drawing …';
      this.say({ type: 'view', n: this.n, state, ...asked });
    }, AFTER_QUIET);
  }

  build(values) {
    this.say({ type: 'factors', values });
  }

  say(message) {
    if (this.ws?.readyState === WebSocket.OPEN) this.ws.send(JSON.stringify(message));
  }

  // --- the line ----------------------------------------------------------------------------------------------------
  connect() {
    const ws = new WebSocket(`ws://${location.host}/live`);
    ws.binaryType = 'arraybuffer';
    this.ws = ws;
    ws.onmessage = (event) => { typeof event.data === 'string' ? this.told(JSON.parse(event.data)) : this.answered(event.data); };
    ws.onclose = (event) => this.lost(event.reason);
  }

  // an answer that does not come is said, too, and so is a server that was stopped
  silence() {
    const [asked] = this.waiting.values();
    const seconds = (performance.now() - asked) / 1000;
    if (1000 * seconds > SLOW) this.status(`no answer for ${Math.floor(seconds)} s`, true);
  }

  async lost(reason) {
    this.waiting.clear();
    this.status(reason || 'no connection, trying again', true);
    await new Promise((done) => setTimeout(done, this.wait));
    this.wait = Math.min(5000, 1.5 * this.wait);
    try {
      const session = await fetch('session', { cache: 'no-store' });
      if (session.status === 403) {
        this.status('the program was started anew; open the address that it printed', true);
        setTimeout(() => this.lost('the program was started anew; open the address that it printed'), 4000);
        return;
      }
    } catch {
      this.lost(reason);
      return;
    }
    this.connect();
  }

  status(text, bad = false) {
    byId('status').textContent = text;
    byId('status').classList.toggle('bad', bad);
  }

  // --- what is told ------------------------------------------------------------------------------------------------
  told(message) {
    switch (message.type) {
      case 'hello': this.greet(message); break;
      case 'building': this.status('building the instrument'); break;
      case 'view': this.picture(message); break;
      case 'file': this.file(message); break;
      case 'blind': this.setBlind(message.on); break;
      case 'revealed': this.reveal(message); break;
      case 'record': this.recording(message); break;
      case 'refused':
        this.note(message.problem);
        this.waiting.clear();
        break;
    }
  }

  greet(hello) {
    const same = this.hello && this.hello.instrument === hello.instrument
      && JSON.stringify(this.hello.channels) === JSON.stringify(hello.channels);
    const values = same ? this.knobs.values() : null;
    const first = !this.hello;
    this.hello = hello;
    this.wait = 500;
    this.waiting.clear();
    byId('name').textContent = hello.instrument;
    byId('opened').textContent = hello.opened;
    byId('opened').title = hello.about;
    document.body.classList.toggle('no-monitor', !hello.channels.length);
    document.title = `${hello.opened || hello.instrument} · live twin`;
    if (first) {
      byId('frames').value = Math.min(64, hello.frames);
      byId('seed').value = hello.seed;
      byId('blind').disabled = !hello.disturbances;
    }
    this.knobs.build(hello, values);
    this.spots.build(hello);
    this.readings.build(hello);
    this.optics.build(hello);
    byId('save-camera').hidden = !hello.design;
    byId('view-field').parentElement.hidden = Boolean(hello.design);
    if (!same || hello.factors.length) this.scene.load();
    const select = byId('view-camera');
    select.replaceChildren(...hello.cameras.map((name) => new Option(name, name)));
    this.setBlind(false);
    this.recording({ on: false, states: 0 });
    this.snapshot = JSON.stringify(this.knobs.values());
    this.status('computing the first state');
    this.changed();
  }

  answered(buffer) {
    const length = new DataView(buffer).getUint32(0, true);
    const told = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    const images = {};
    let at = 4 + length;
    for (const [name, [channels, rows, columns]] of Object.entries(told.images)) {
      images[name] = { channels, rows, columns, pixels: new Uint16Array(buffer, at, channels * rows * columns) };
      at += 2 * channels * rows * columns;
    }
    for (const n of this.waiting.keys()) if (n <= told.n) this.waiting.delete(n);
    this.ask();
    this.paint(told, images);
  }

  paint(told, images) {
    this.last = told;
    document.body.classList.remove('waiting');
    this.problem(told);
    this.spots.take(told, images);
    if (!told.problem) {
      this.readings.take(told);
      this.optics.take(told, images);
      this.scene.place(told.motions ?? {});
    }
    requestAnimationFrame(() => {
      this.spots.draw();
      this.readings.draw();
      this.optics.draw();
      // the next task comes after this frame's painting
      setTimeout(() => this.painted(told), 0);
    });
  }

  painted(told) {
    const now = performance.now();
    this.shown = told.n;
    if (told.t) this.latencies.push(now - told.t);
    if (this.latencies.length > 5000) this.latencies.shift();
    this.paints.push(now);
    while (this.paints.length && this.paints[0] < now - 2000) this.paints.shift();
    const recent = this.latencies.slice(-9).sort((a, b) => a - b);
    const rate = this.paints.length / 2;
    const delay = recent.length ? `${Math.round(recent[recent.length >> 1])} ms` : '';
    this.status(`${delay} · computed in ${Math.round(told.ms)} ms${rate > 1 ? ` · ${rate.toFixed(0)} a second` : ''}`);
    document.body.dataset.shown = told.n;
    if (this.hello.design && !this.resting && !told.problem) {
      clearTimeout(this.rest);
      this.rest = setTimeout(() => { this.resting = true; this.dirty = true; this.ask(); }, AFTER_QUIET);
    }
    this.askView();
  }

  problem(told) {
    const box = byId('problem');
    const collisions = told.collisions ?? [];
    box.hidden = !told.problem && !collisions.length;
    document.body.classList.toggle('lost', Boolean(told.problem));
    if (!box.hidden) {
      const list = document.createElement('ul');
      for (const cause of told.problem ? told.causes : collisions) {
        list.append(Object.assign(document.createElement('li'), { textContent: cause }));
      }
      const text = told.problem ? `${told.problem}; shown is the last good state` : 'bodies are in each other';
      box.replaceChildren(text, list);
    }
    const warnings = told.warnings ?? [];
    byId('notes').hidden = !warnings.length;
    byId('notes').textContent = warnings.join('; ');
  }

  note(text) {
    byId('problem').hidden = false;
    byId('problem').textContent = text;
  }

  picture(message) {
    const image = byId('picture');
    byId('picture-problem').textContent = message.problem ?? '';
    image.hidden = !message.svg;
    if (!message.svg) return;
    const svg = message.svg.replace('<svg', '<svg xmlns="http://www.w3.org/2000/svg"');
    const old = image.src;
    image.src = URL.createObjectURL(new Blob([svg], { type: 'image/svg+xml' }));
    image.alt = `${byId('view-what').selectedOptions[0].text} of camera ${message.camera}`;
    if (old.startsWith('blob:')) URL.revokeObjectURL(old);
  }

  file(message) {
    if (message.problem) { this.note(message.problem); return; }
    const link = document.createElement('a');
    link.href = URL.createObjectURL(new Blob([message.text], { type: 'application/yaml' }));
    link.download = message.name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }

  recording({ on, states }) {
    byId('record').setAttribute('aria-pressed', on);
    byId('record').textContent = on ? 'Stop' : 'Record';
    byId('save-course').disabled = on || !states;
  }

  setBlind(on) {
    if (on && !this.blind) { this.knobs.reset(); }
    this.blind = on;
    byId('blind').setAttribute('aria-pressed', on);
    byId('blind').textContent = on ? 'Reveal' : 'Blind';
    byId('show').querySelector('[value=guess]').hidden = !on;
    if (!on && byId('show').value === 'guess') byId('show').value = 'after';
    this.spots.blind = on;
    this.readings.blind = on;
    this.changed();
  }

  reveal({ hidden, truth }) {
    const rows = (hidden ?? []).slice(0, 40).map(({ what, value, unit, sigmas }) => (
      `${what}\t${value.toPrecision(3)} ${unit}\t${sigmas >= 0 ? '+' : '−'}${Math.abs(sigmas).toFixed(1)} σ`));
    for (const [camera, values] of Object.entries(truth?.cameras ?? {})) {
      for (const { key, symbol, unit } of this.hello.parameters) {
        rows.push(`${camera} ${symbol}, truly\t${values[key].toPrecision(4)} ${unit}\t`);
      }
    }
    const table = byId('revealed').querySelector('table');
    table.replaceChildren(...rows.map((row) => {
      const tr = document.createElement('tr');
      tr.append(...row.split('\t').map((text) => Object.assign(document.createElement('td'), { textContent: text })));
      return tr;
    }));
    byId('revealed').showModal();
  }
}

window.liveTwin = new Live();
