// Readings of all estimators beside the truth, and a strip chart of one of them.
import { decimals, fixed } from './format.js';

const byId = (id) => document.getElementById(id);
const MOST = 6000; // points of the strip chart
const FAR = 3; // sigma from which an error is marked

export class Readings {
  constructor() {
    this.blind = false;
    this.points = [];
    byId('strip-what').addEventListener('input', () => this.strip());
    byId('strip-span').addEventListener('input', () => this.strip());
    setInterval(() => this.strip(), 1000);
  }

  build(hello) {
    this.hello = hello;
    this.told = null;
    this.points = [];
    const own = hello.parameters.map((parameter) => ({ ...parameter }));
    this.groups = hello.cameras.map((camera) => ({
      title: camera, rows: own.map((p) => ({ ...p, truth: (t) => t.cameras[camera][p.key], reading: (r, e) => r.cameras[camera][e] })),
    }));
    if (hello.angle) {
      this.groups.push({ title: 'both', rows: [{ ...hello.angle, truth: (t) => t.intersection_angle[hello.angle.key], reading: (r, e) => r.intersection_angle[e] }] });
    }
    if (hello.ground.length) {
      this.groups.push({ title: 'ground', rows: hello.ground.map((p) => ({ ...p, truth: (t) => t.ground[p.key], reading: (r, e) => r.ground[e] })) });
    }
    this.monitored = hello.estimators.length > 0;
    for (const camera of this.monitored ? [] : hello.cameras) {
      const at = (quality, path) => path.reduce((part, key) => part?.[key], quality?.cameras[camera]);
      this.groups.push({
        title: `${camera}, images`,
        rows: hello.images.map((one) => ({ ...one, key: one.path[0], meaning: '', designed: at(hello.designed, one.path), now: (told) => at(told.quality, one.path) })),
      });
    }
    const head = document.createElement('tr');
    const heads = this.monitored ? ['true', ...hello.estimators.map((name) => name.replaceAll('_', ' ')), 'σ', 'error', 'in σ'] : ['now', 'as designed'];
    for (const name of ['', ...heads]) {
      const cell = Object.assign(document.createElement('th'), { textContent: name, scope: 'col' });
      if (name === hello.judged) cell.className = 'judged';
      head.append(cell);
    }
    byId('readings').tHead.replaceChildren(head);
    const body = byId('readings').tBodies[0];
    body.replaceChildren();
    for (const group of this.groups) {
      const title = body.insertRow();
      title.className = 'head';
      title.insertCell().textContent = group.title;
      for (const row of group.rows) {
        row.line = body.insertRow();
        const name = row.line.insertCell();
        name.textContent = row.unit ? `${row.symbol} [${row.unit}]` : row.symbol;
        name.title = row.meaning;
        row.cells = Array.from({ length: heads.length }, () => row.line.insertCell());
        if (this.monitored) row.cells[1 + hello.estimators.indexOf(hello.judged)].className = 'judged';
        for (const cell of row.cells) cell.textContent = '…';
        row.texts = [];
        row.name = `${group.title} ${name.textContent}`;
      }
    }
    this.rows = this.groups.flatMap((group) => group.rows);
    const select = byId('strip-what');
    const chosen = select.value;
    select.replaceChildren(...this.rows.map((row, k) => new Option(row.name, String(k))));
    const angle = this.rows.findIndex((row) => ['change_arcsec', 'wfe_rms_waves'].includes(row.key));
    select.value = chosen || String(angle >= 0 ? angle : 0);
  }

  take(told) {
    // image quality follows when the knobs rest
    if (this.told?.quality && !told.quality && !told.warnings?.length) told.quality = this.told.quality;
    this.told = told;
    const judged = this.hello.judged;
    const values = this.rows.map((row) => {
      if (!this.monitored) return [NaN, this.traced(row), 0];
      const reading = row.reading(told.readings, judged);
      return [told.truth ? row.truth(told.truth) : NaN, reading[row.key], reading[`${row.key}_sigma`]];
    });
    this.points.push({ time: performance.now() / 1000, values });
    if (this.points.length > MOST) this.points.splice(0, this.points.length - MOST);
  }

  // what a row of an instrument without a monitor is now
  traced(row) {
    return (row.now ? row.now(this.told) : row.truth(this.told.truth)) ?? NaN;
  }

  drawTraced() {
    for (const row of this.rows) {
      const texts = [fixed(this.traced(row), 4), fixed(row.now ? row.designed : 0, 4)];
      texts.forEach((text, k) => { if (row.texts[k] !== text) row.cells[k].textContent = text; });
      row.texts = texts;
    }
    byId('consistency').textContent = 'Changes of the geometry by exact chief rays; images at the middle of the line, worst over the whole of it. The instrument has no monitor.';
    this.strip();
  }

  draw() {
    const told = this.told;
    if (!told) return;
    if (!this.monitored) { this.drawTraced(); return; }
    const { estimators, judged } = this.hello;
    for (const row of this.rows) {
      const own = row.reading(told.readings, judged);
      const sigma = own[`${row.key}_sigma`];
      const places = decimals(sigma);
      const truth = told.truth ? row.truth(told.truth) : undefined;
      const error = truth === undefined ? undefined : own[row.key] - truth;
      const texts = [fixed(truth, places), ...estimators.map((name) => fixed(row.reading(told.readings, name)[row.key], places)),
        fixed(sigma, places), fixed(error, places), error === undefined ? '–' : fixed(error / sigma, 1)];
      texts.forEach((text, k) => { if (row.texts[k] !== text) row.cells[k].textContent = text; });
      row.texts = texts;
      row.cells[texts.length - 1].classList.toggle('far', error !== undefined && Math.abs(error / sigma) > FAR);
    }
    const found = told.readings.disturbances;
    byId('consistency').textContent = found
      ? `σ, error and in σ are of ${judged}. The shifts ${found.agrees ? 'agree' : 'do NOT agree'} with the prior “${found.name}”: `
        + `χ² ${found.chi_square.toPrecision(3)} with ${found.degrees_of_freedom} degrees of freedom, limit ${found.limit.toPrecision(3)}`
        + `${found.agrees || !found.suspects.length ? '.' : `; suspects: ${found.suspects.slice(0, 3).map((one) => one.body).join(', ')}.`}`
      : `σ, error and in σ are of ${judged}: of the noise alone, since there is no prior.`;
    this.strip();
  }

  strip() {
    const canvas = byId('strip');
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !this.rows) return;
    if (canvas.width !== Math.round(width * ratio)) { canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio); }
    const pen = canvas.getContext('2d', { willReadFrequently: true });
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const span = Number(byId('strip-span').value);
    const now = performance.now() / 1000;
    const k = Number(byId('strip-what').value);
    const points = this.points.filter(({ time }) => time > now - span);
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name).trim();
    if (!points.length) return;
    let [low, high] = [Infinity, -Infinity];
    for (const { values } of points) {
      const [truth, reading, sigma] = values[k];
      const shown = [reading - sigma, reading + sigma, ...(Number.isFinite(truth) && !this.blind ? [truth] : [])];
      for (const value of shown) { low = Math.min(low, value); high = Math.max(high, value); }
    }
    if (!(high > low)) { low -= 1e-6; high += 1e-6; }
    const pad = 0.08 * (high - low);
    [low, high] = [low - pad, high + pad];
    const [left, bottom] = [62, height - 18];
    const x = (time) => left + ((width - left - 6) * (time - now + span)) / span;
    const y = (value) => 6 + ((bottom - 6) * (high - value)) / (high - low);
    pen.font = '11px system-ui, sans-serif';
    pen.fillStyle = colour('--soft');
    pen.strokeStyle = colour('--line');
    // round numbers, three to six of them
    const rough = (high - low) / 4;
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find((times) => times * power >= rough);
    const places = Math.max(0, Math.min(9, -Math.floor(Math.log10(step) + 1e-9)));
    pen.textAlign = 'right';
    for (let value = step * Math.ceil(low / step); value <= high; value += step) {
      pen.beginPath();
      pen.moveTo(left, y(value));
      pen.lineTo(width - 6, y(value));
      pen.stroke();
      pen.fillText(fixed(value, places), left - 4, y(value) + 4);
    }
    pen.textAlign = 'center';
    for (let tick = 0; tick <= 4; tick += 1) pen.fillText(`${(-span * (4 - tick)) / 4} s`.replace('-', '−'), Math.min(width - 16, x(now - (span * (4 - tick)) / 4)), height - 4);
    // a state holds until the next one
    const held = (value) => {
      pen.beginPath();
      points.forEach(({ time, values }, i) => {
        const end = i + 1 < points.length ? points[i + 1].time : now;
        pen.lineTo(x(time), y(value(values[k])));
        pen.lineTo(x(end), y(value(values[k])));
      });
    };
    pen.fillStyle = colour('--after');
    pen.globalAlpha = 0.18;
    points.forEach(({ time, values }, i) => {
      const end = i + 1 < points.length ? points[i + 1].time : now;
      const [, reading, sigma] = values[k];
      pen.fillRect(x(time), y(reading + sigma), Math.max(1, x(end) - x(time)), y(reading - sigma) - y(reading + sigma));
    });
    pen.globalAlpha = 1;
    pen.lineWidth = 1.5;
    pen.strokeStyle = colour('--after');
    held(([, reading]) => reading);
    pen.stroke();
    if (!this.blind && points.some(({ values }) => Number.isFinite(values[k][0]))) {
      pen.strokeStyle = colour('--before');
      held(([truth]) => truth);
      pen.stroke();
    }
    pen.textAlign = 'left';
    pen.fillStyle = colour('--after');
    pen.fillText(this.monitored ? `${this.hello.judged} ± σ` : 'traced', left + 6, 18);
    if (!this.blind && this.monitored) { pen.fillStyle = colour('--before'); pen.fillText('truth', left + 90, 18); }
  }
}
