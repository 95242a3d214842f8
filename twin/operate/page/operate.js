// The page of an instrument in operation: asks for what is new in the record, and shows it.
import { Chart } from './chart.js';
import { decimals, fixed } from './format.js';
import { Panels } from './panels.js';
import { Reading } from './reading.js';
import { Scene } from './scene.js';

const byId = (id) => document.getElementById(id);
const POLL = 3000; // ms from one question for news to the next
const DAY = 86400e6; // microseconds

class Operate {
  constructor() {
    this.version = 0;
    this.state = null;
    this.quantity = -1;
    this.days = 30;
    this.end = null; // of the span, null for the newest
    this.mayWrite = false;
    this.chart = new Chart(byId('chart'), { picked: (time) => this.choose(time), hovered: (time) => this.hover(time) });
    this.innovations = new Chart(byId('innovations'), { log: true, picked: (time) => this.choose(time) });
    this.panels = new Panels(this);
    this.reading = new Reading(this);
    this.scene = new Scene(byId('scene'), 1.05);
    byId('what').addEventListener('input', () => { this.quantity = Number(byId('what').value); this.draw(); this.panels.now(this.state, this.quantity); });
    for (const button of byId('spans').children) {
      button.addEventListener('click', () => { this.days = Number(button.dataset.days); this.trend(); });
    }
    byId('earlier').addEventListener('click', () => this.pan(-0.5));
    byId('later').addEventListener('click', () => this.pan(0.5));
    for (const id of ['forecast', 'points']) byId(id).addEventListener('input', () => { if (id === 'forecast') this.trend(); else this.draw(); });
    byId('chart').addEventListener('keydown', (event) => {
      const step = { ArrowLeft: 'before', ArrowRight: 'after' }[event.key];
      if (step) { event.preventDefault(); this.reading.step(step); }
    });
    this.poll();
  }

  // --- what is new ------------------------------------------------------------------------------------------------
  async ask(path) {
    const answer = await fetch(path, { cache: 'no-store' });
    if (answer.status === 403) throw new Error('the program was started anew; open the address that it printed');
    if (!answer.ok) throw new Error((await answer.text()).trim());
    return answer.json();
  }

  async poll() {
    try {
      const news = await this.ask('news');
      if (news.may_write !== this.mayWrite || news.writable !== this.writable) {
        Object.assign(this, { mayWrite: news.may_write, writable: news.writable });
        if (this.state) this.panels.alarms(this.state);
      }
      if (news.version !== this.version) await this.load(news.version);
      const troubled = Boolean(news.trouble);
      this.status(troubled ? `the record cannot be read: ${news.trouble}` : `looked at ${new Date().toLocaleTimeString()}`, troubled);
    } catch (error) {
      this.status(error instanceof TypeError ? 'no connection, trying again' : error.message, true);
    }
    setTimeout(() => this.poll(), POLL);
  }

  status(text, bad = false) {
    byId('status').textContent = text;
    byId('status').classList.toggle('bad', bad);
  }

  problem(text) {
    byId('problem').hidden = !text;
    byId('problem').textContent = text;
  }

  async load(version) {
    const first = !this.state;
    this.state = await this.ask('state');
    this.version = version;
    const { state } = this;
    document.body.classList.remove('waiting');
    document.title = `${state.instrument} · in operation`;
    byId('name').textContent = state.instrument;
    byId('newest').textContent = `${state.readings.toLocaleString('en')} readings, the newest ${this.text(state.utc)} UTC`;
    this.chart.offset = this.innovations.offset = state.tai_minus_unix_us;
    if (this.quantity < 0) this.quantity = Math.max(0, state.quantities.findIndex(({ required }) => required));
    byId('what').replaceChildren(...state.quantities.map(({ name, unit }, k) => new Option(`${name} [${unit}]`, String(k))));
    byId('what').value = String(this.quantity);
    this.panels.all(state, this.quantity);
    this.predicted();
    if (first) this.scene.load();
    const choosing = first ? this.choose(state.time_us) : null;
    await this.trend();
    await choosing;
    if (first) return this.loaded(version);
    if (this.follows) await this.choose(state.time_us);
    this.loaded(version);
  }

  loaded(version) { document.body.dataset.version = String(version); }

  // --- times ------------------------------------------------------------------------------------------------------
  // UTC of a time in ISO 8601, to the minute
  text(utc) { return utc.slice(0, 16).replace('T', ' '); }

  said(time) { return this.text(this.chart.date(time).toISOString()); }

  span() {
    const { state } = this;
    const ahead = byId('forecast').checked ? state.last_us - state.time_us : 0;
    const whole = this.days ? this.days * DAY : state.time_us - state.first_us;
    const until = this.end ?? state.time_us;
    const from = Math.max(this.days ? until - whole : state.first_us, state.first_us - 0.02 * whole);
    return [Math.round(from), Math.round(this.end === null ? until + Math.min(ahead, Math.max(whole, 7 * DAY)) : until)];
  }

  pan(share) {
    if (!this.days) return;
    const moved = (this.end ?? this.state.time_us) + share * this.days * DAY;
    this.end = moved >= this.state.time_us ? null : Math.max(moved, this.state.first_us + 0.25 * this.days * DAY);
    this.trend();
  }

  // the time about which the trend is shown
  around(time) {
    this.days = 30;
    this.end = Math.min(this.state.time_us, time + 15 * DAY);
    if (this.end === this.state.time_us) this.end = null;
    this.trend();
    this.choose(time);
    byId('trends').scrollIntoView({ behavior: 'smooth', block: 'start' });
  }

  // --- trends -----------------------------------------------------------------------------------------------------
  async trend() {
    for (const button of byId('spans').children) button.setAttribute('aria-pressed', String(Number(button.dataset.days) === this.days));
    const [from, to] = this.span();
    const asked = (this.asked = `${from} ${to}`);
    const slow = setTimeout(() => { byId('chart-said').textContent = 'The course is being worked out from all readings …'; }, 400);
    try {
      const told = await this.ask(`trend?from=${from}&to=${to}`);
      if (asked === this.asked) { this.told = told; this.draw(); this.problem(''); }
    } catch (error) {
      this.problem(error.message);
    }
    clearTimeout(slow);
  }

  draw() {
    const { told, state, quantity: q } = this;
    if (!told) return;
    const course = (name, one) => ({ name, times: one.times, values: one.values[q], sigmas: one.sigmas[q] });
    const courses = [course('past', told.past)];
    if (told.future && byId('forecast').checked) courses.push(course('future', told.future));
    const single = byId('points').checked ? told.points : { times: [], values: [], sigmas: [] };
    const { required } = state.quantities[q];
    this.chart.show({
      from: told.from_us, to: told.to_us, courses, limit: required?.limit, chosen: this.chosen,
      points: { times: single.times, values: single.values[q] ?? [], sigmas: single.sigmas[q] ?? [] },
      jumps: state.jumps.map(({ after_us, until_us, body, until }) => ({ from: after_us, to: until_us, name: `jump of ${body}, ${this.text(until)}` })),
      events: state.events.map(({ time_us, name, utc }) => ({ at: time_us, name: `${name.replaceAll('_', ' ')}, ${this.text(utc)}` })),
    });
    this.hover(null);
  }

  // the number under the pointer, or the newest one
  hover(time) {
    const { told, state, quantity: q } = this;
    if (!told) return;
    const future = told.future && time !== null && time > told.now_us ? told.future : null;
    const course = future ?? told.past;
    let k = course.times.length - 1;
    if (time !== null) k = course.times.reduce((best, at, i) => (Math.abs(at - time) < Math.abs(course.times[best] - time) ? i : best), 0);
    const { name, unit } = state.quantities[q];
    const [value, sigma] = [course.values[q][k], course.sigmas[q][k]];
    const places = decimals(sigma);
    byId('chart-said').textContent = `${this.said(course.times[k])} UTC: ${name} ${fixed(value, places)} ± ${fixed(sigma, places)} ${unit}${future ? ', forecast' : ''}`;
  }

  predicted() {
    const { state } = this;
    const told = state.innovations;
    byId('predictions-said').textContent = `${state.predictions}.${state.log_score === null ? '' : ` Mean log score of a reading: ${fixed(state.log_score, 3)}, larger is better.`}`;
    const above = told.filter(([, chi, , limit]) => chi > limit).length;
    byId('innovations-said').textContent = told.length
      ? `Chi-square of the last ${told.length} readings against their predictions; ${above} above the limit (line), of ${(state.false_alarm * told.length).toFixed(1)} expected.`
      : 'No reading has been predicted yet.';
    const times = told.map(([time]) => time);
    const from = times[0] ?? 0;
    const to = times[times.length - 1] ?? 1;
    this.innovations.show({
      from: from - 0.01 * (to - from) - 1e6, to: to + 0.01 * (to - from) + 1e6,
      courses: [{ name: 'limit', times, values: told.map(([, , , limit]) => limit) }],
      points: { times, values: told.map(([, chi]) => Math.max(chi, 1e-3)), far: told.map(([, chi, , limit]) => chi > limit) },
    });
  }

  // --- one moment -------------------------------------------------------------------------------------------------
  async choose(time) {
    this.follows = time === this.state.time_us; // who looks at the newest reading gets the next one, too
    try {
      const asked = (this.wanted = time);
      await this.reading.load(time);
      this.chosen = time <= this.state.time_us ? this.reading.told.time_us : time;
      this.draw();
      const motions = await this.ask(`motions?time=${Math.round(this.chosen)}`);
      if (asked !== this.wanted) return;
      this.scene.place(motions.moved);
      byId('space-caption').textContent = `${this.text(motions.utc)} UTC${motions.time_us > this.state.time_us ? ', forecast' : ''}: the mean of the estimate. Orange bodies moved by more than 2σ. Light as designed. Drag turns, wheel zooms, right button shifts.`;
      this.panels.largest(motions.largest);
      document.body.dataset.chosen = String(this.chosen);
      this.problem('');
    } catch (error) {
      this.problem(error.message);
    }
  }

  async acknowledge(alarm, by, note) {
    const answer = await fetch('acknowledge', {
      method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify({ alarm, by, note }),
    });
    if (!answer.ok) throw new Error((await answer.text()).trim());
    const { version } = await answer.json();
    await this.load(version);
  }
}

window.operate = new Operate();
