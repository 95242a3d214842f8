// Tables of the page: what is now, alarms with their acknowledgements, jumps, events, sensors, what was left out.
import { decimals, fixed } from './format.js';

const byId = (id) => document.getElementById(id);
const FIRST = 25; // rows that are shown at once

const cell = (text, look = '', kind = 'td') => Object.assign(document.createElement(kind), { textContent: text, className: look });
const words = (text) => cell(text, 'words');
const unit = (text) => text.replace('um', 'µm');

// a chance in percent, with as many decimals as tell it from certainty
export const percent = (chance) => {
  const rest = Math.min(chance, 1 - chance);
  if (rest < 1e-6) return chance < 0.5 ? '< 0.0001 %' : '> 99.9999 %';
  return `${(100 * chance).toFixed(decimals(100 * rest))} %`;
};

export class Panels {
  constructor(page) {
    this.page = page;
    byId('acknowledge-cancel').addEventListener('click', () => byId('acknowledge').close());
    byId('acknowledge').querySelector('form').addEventListener('submit', (event) => { event.preventDefault(); this.send(); });
  }

  all(state, quantity) {
    this.verdict(state);
    this.alarms(state);
    this.now(state, quantity);
    this.coverage(state);
    this.jumps(state);
    this.table('events', ['UTC', 'event', 'may step'], state.events.slice().reverse(), (one) => [
      cell(this.page.text(one.utc), 'when'), words(one.name.replaceAll('_', ' ')), words(one.causes.join(', ') || '–'),
    ], 'The record has no event.', { picked: (one) => this.page.around(one.time_us) });
    const sensors = state.sensors.slice().sort((a, b) => (a.state === 'ok') - (b.state === 'ok'));
    this.table('sensors', ['body', 'state', 'since', 'last reading', 'why'], sensors, (one) => [
      words(one.body), cell(one.state, one.state === 'ok' ? 'words good' : 'words bad'), cell(one.since ? this.page.text(one.since) : '–', 'when'),
      cell(one.last ? this.page.text(one.last) : '–', 'when'), words(one.reason || '–'),
    ], 'The record has no temperature.', { few: Math.max(6, state.sensors.filter((one) => one.state !== 'ok').length) });
    this.table('left-out', ['UTC', 'sort', 'of', 'why'], state.left_out, (one) => [
      cell(this.page.text(one.utc), 'when'), words(one.kind), words(one.subject), words(one.reason),
    ], 'Nothing was left out.', { count: state.left_out_count });
  }

  verdict(state) {
    const [first, ...more] = state.sentences;
    const box = byId('verdict');
    box.className = state.holds ? 'good' : 'bad';
    const lead = Object.assign(document.createElement('p'), { textContent: `${first}.` });
    lead.className = 'first';
    box.replaceChildren(lead, ...more.map((text) => Object.assign(document.createElement('p'), { textContent: `${text}.` })));
  }

  // rows with heads; the first ones, and the others when they are asked for
  table(id, heads, rows, cells, empty, { picked = null, count = rows.length, few = FIRST } = {}) {
    const table = byId(id);
    if (!rows.length) {
      const none = table.createTBody();
      table.replaceChildren(none);
      none.insertRow().append(cell(empty, 'words none'));
      return;
    }
    const head = document.createElement('thead');
    const line = head.insertRow();
    for (const name of heads) { const one = cell(name, '', 'th'); one.scope = 'col'; line.append(one); }
    const body = document.createElement('tbody');
    table.replaceChildren(head, body);
    const add = (some) => {
      for (const one of some) {
        const row = body.insertRow();
        row.append(...cells(one));
        if (picked) this.pickable(row, () => picked(one));
      }
    };
    add(rows.slice(0, few));
    if (count <= few) return;
    const more = Object.assign(document.createElement('button'), { textContent: `show all ${rows.length}` });
    const last = body.insertRow();
    last.insertCell().append(more);
    last.cells[0].colSpan = heads.length;
    last.cells[0].className = 'words';
    if (count > rows.length) last.cells[0].append(` of ${count}, the newest`);
    more.addEventListener('click', () => { last.remove(); add(rows.slice(few)); });
  }

  pickable(row, picked) {
    row.className = 'pick';
    row.tabIndex = 0;
    row.addEventListener('click', picked);
    row.addEventListener('keydown', (event) => { if (event.key === 'Enter') picked(); });
  }

  now(state, chosen) {
    const body = byId('now').tBodies[0];
    body.replaceChildren();
    let group = '';
    state.quantities.forEach((one, k) => {
      if (one.group !== group) {
        group = one.group;
        const title = body.insertRow();
        title.className = 'head';
        title.append(words(group));
        title.cells[0].colSpan = 7;
      }
      const row = body.insertRow();
      const places = decimals(one.sigma);
      const own = one.required;
      const name = words(`${one.symbol} [${one.unit}]`);
      name.title = one.meaning;
      row.append(name, cell(fixed(one.value, places)), cell(fixed(one.sigma, places)));
      if (own) {
        row.append(cell(`±${Number(own.limit.toPrecision(6))}`), cell(percent(own.chance), own.holds ? 'good' : 'bad'), cell(percent(1 - own.probability)));
        row.append(cell(!own.holds ? 'broken' : own.breaks ? own.breaks.slice(0, 10) : 'not in the forecast', own.holds && !own.breaks ? '' : 'bad'));
      } else {
        row.append(...['', '', '', ''].map((text) => cell(text)));
      }
      this.pickable(row, () => { byId('what').value = String(k); byId('what').dispatchEvent(new Event('input')); });
      row.classList.toggle('chosen', k === chosen);
    });
  }

  coverage(state) {
    const rows = state.coverage.map((one) => {
      const row = document.createElement('tr');
      const share = (value) => (value === null ? '–' : `${(100 * value).toFixed(1)} %`);
      row.append(words(`within ${one.sigmas}σ`), cell(share(one.expected)), cell(share(one.share), one.count ? (one.holds ? 'good' : 'bad') : ''));
      row.append(cell(one.count ? `${(100 * one.low).toFixed(1)} to ${share(one.high)}` : '–'), cell(one.count.toLocaleString('en')));
      return row;
    });
    byId('coverage').tBodies[0].replaceChildren(...rows);
  }

  jumps(state) {
    const newest = state.jumps.slice().sort((a, b) => b.until_us - a.until_us);
    this.table('jumps', ['until [UTC]', 'body', 'best known part', 'size', 'did to the line', 'log ratio', 'or else'], newest, (one) => {
      const size = one.part;
      const places = decimals(size.sigma);
      const since = cell(this.page.text(one.until), 'when');
      since.title = `between ${this.page.text(one.after)} and ${this.page.text(one.until)} UTC, told at ${this.page.text(one.told)}; false alarm ${one.false_alarm.toPrecision(1)}`;
      return [
        since, words(one.body), words(size.label.replace(`${one.body} `, '')),
        cell(`${fixed(size.size, places)} ± ${fixed(size.sigma, places)} ${unit(size.unit)}`),
        words(one.carried || '–'), cell(fixed(one.log_ratio, 1)), words(one.rivals || '–'),
      ];
    }, 'No jump was found.', { picked: (one) => this.page.around(one.until_us) });
  }

  largest(rows) {
    byId('largest').tBodies[0].replaceChildren(...rows.map((one) => {
      const places = decimals(one.sigma);
      const row = document.createElement('tr');
      row.append(words(one.label), cell(`${fixed(one.mean, places)} ${unit(one.unit)}`), cell(fixed(one.sigma, places)), cell(one.sigma > 0 ? fixed(one.mean / one.sigma, 1) : '–'));
      return row;
    }));
  }

  // --- alarms -----------------------------------------------------------------------------------------------------
  alarms(state) {
    const open = state.alarms.filter(({ acknowledged }) => !acknowledged);
    byId('alarm-count').textContent = state.alarms.length ? `${open.length} open of ${state.alarms.length}` : '';
    byId('alarm-count').className = open.length ? 'bad' : '';
    const { mayWrite, writable } = this.page;
    byId('alarm-mode').textContent = !state.alarms.length ? 'No alarm has been raised.'
      : mayWrite ? ''
        : writable ? 'Read only here: the address for writing, which the command printed, can acknowledge.'
          : 'Read only: the command was started without --write-token.';
    byId('alarm-list').replaceChildren(...[...open, ...state.alarms.filter((one) => !open.includes(one))].map((one) => this.alarm(one)));
  }

  alarm(one) {
    const box = document.createElement('article');
    const known = Boolean(one.acknowledged);
    box.className = known ? 'alarm known' : 'alarm';
    box.dataset.alarm = String(one.id);
    const head = document.createElement('p');
    head.append(cell(this.page.text(one.time_utc), 'when', 'span'), ' ', cell(one.kind.replaceAll('_', ' '), 'kind', 'span'), ' ', cell(one.text, '', 'span'));
    box.append(head);
    if (known) {
      const { by, note, acknowledged_utc: at } = one.acknowledged;
      box.append(cell(`acknowledged by ${by}, ${this.page.text(at)} UTC${note ? `: ${note}` : ''}`, 'caption', 'p'));
    }
    if (!known && this.page.mayWrite) {
      const button = Object.assign(document.createElement('button'), { textContent: 'Acknowledge' });
      button.addEventListener('click', () => this.open(one));
      box.append(button);
    }
    return box;
  }

  open(one) {
    this.chosen = one.id;
    byId('acknowledge-what').textContent = one.text;
    byId('acknowledge-problem').textContent = '';
    byId('note').value = '';
    byId('acknowledge').showModal();
  }

  async send() {
    const submit = byId('acknowledge').querySelector('[type=submit]');
    submit.disabled = true; // once, however often it is pressed
    try {
      await this.page.acknowledge(this.chosen, byId('by').value, byId('note').value);
      byId('acknowledge').close();
    } catch (error) {
      byId('acknowledge-problem').textContent = error.message;
    }
    submit.disabled = false;
  }
}
