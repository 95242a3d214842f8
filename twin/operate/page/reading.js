// One reading: where its spots were before and after, and its frames where their files are still there.
import { decimals, fixed } from './format.js';

const byId = (id) => document.getElementById(id);
const SPACE = 'http://www.w3.org/2000/svg';
const REACH = 0.38; // of the side of a picture, for the longest arrow

const made = (name, attributes) => {
  const node = document.createElementNS(SPACE, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  return node;
};

export class Reading {
  constructor(page) {
    this.page = page;
    this.told = null;
    for (const id of ['before', 'after']) byId(id).addEventListener('click', () => this.step(id));
    byId('last').addEventListener('click', () => page.choose(page.state.time_us));
  }

  step(way) {
    const time = this.told?.[`${way}_us`];
    if (time) this.page.choose(time);
  }

  async load(time) {
    const told = await this.page.ask(`reading?time=${Math.round(time)}`);
    this.told = told;
    byId('before').disabled = told.before_us === null;
    byId('after').disabled = byId('last').disabled = told.after_us === null;
    byId('reading-time').textContent = `${this.page.text(told.utc)} UTC`;
    this.spots(told);
    this.frames(told);
  }

  spots({ spots, source, sigma_holds: holds }) {
    const { ccd } = this.page.state;
    const shifts = spots.map(({ before, after }) => [after.column - before.column, after.row - before.row]);
    const longest = Math.max(...shifts.map(([x, y]) => Math.hypot(x, y)), 1e-9);
    const rough = (REACH * Math.min(ccd.rows, ccd.columns)) / longest;
    const power = 10 ** Math.floor(Math.log10(rough));
    const factor = power * [5, 2, 1].find((times) => times * power <= rough * 1.001);
    byId('spots').replaceChildren(...spots.map((one, k) => this.spot(one, shifts[k], factor, ccd)));
    const larger = factor >= 1 ? `${factor.toLocaleString('en')} times larger` : `${(1 / factor).toLocaleString('en')} times smaller`;
    byId('spots-caption').textContent = spots.length
      ? `Where the spots were before (blue) and how they moved (arrows, ${larger}), on CCDs of ${ccd.columns} × ${ccd.rows} px; ellipses are 1σ, as much enlarged.${holds === false ? ' Its own checks say that σ does not hold.' : ''} From ${source}.`
      : `This reading has no positions of spots. From ${source}.`;
  }

  spot({ camera, channel, before, after }, [x, y], factor, { rows, columns }) {
    const figure = document.createElement('figure');
    const svg = made('svg', { viewBox: `-0.5 -0.5 ${columns} ${rows}`, class: 'ccd' });
    const thin = 0.006 * Math.max(rows, columns);
    svg.append(made('rect', { x: -0.5, y: -0.5, width: columns, height: rows, class: 'area' }));
    const arm = 5 * thin;
    const [cx, cy] = [before.column, before.row];
    svg.append(made('path', { d: `M${cx - arm} ${cy}h${2 * arm}M${cx} ${cy - arm}v${2 * arm}`, class: 'from', 'stroke-width': thin }));
    const [tx, ty] = [cx + factor * x, cy + factor * y];
    svg.append(made('path', { d: `M${cx} ${cy}L${tx} ${ty}`, class: 'way', 'stroke-width': 1.6 * thin }));
    const angle = Math.atan2(ty - cy, tx - cx);
    const head = Math.min(7 * thin, 0.6 * Math.hypot(tx - cx, ty - cy));
    const side = (turn) => `${tx - head * Math.cos(angle + turn)} ${ty - head * Math.sin(angle + turn)}`;
    svg.append(made('path', { d: `M${side(0.45)}L${tx} ${ty}L${side(-0.45)}`, class: 'way', 'stroke-width': 1.6 * thin }));
    const sigma = ['column', 'row'].map((key) => Math.hypot(before[`${key}_sigma`] ?? 0, after[`${key}_sigma`] ?? 0));
    svg.append(made('ellipse', { cx: tx, cy: ty, rx: factor * sigma[0], ry: factor * sigma[1], class: 'sure', 'stroke-width': thin }));
    const text = (name, value, own) => `${name} ${fixed(value, decimals(own))} ± ${fixed(own, decimals(own))} px`;
    const caption = document.createElement('figcaption');
    caption.append(Object.assign(document.createElement('b'), { textContent: `${camera} ${channel}` }));
    for (const line of [text('column', x, sigma[0]), text('row', y, sigma[1])]) caption.append(Object.assign(document.createElement('span'), { textContent: line }));
    figure.append(svg, caption);
    return figure;
  }

  frames({ frames }) {
    const order = ({ name }) => name.replace('before', '0').replace('after', '1');
    const there = frames.filter(({ state }) => state === 'there').sort((a, b) => order(a).localeCompare(order(b)));
    byId('frames').replaceChildren(...there.map(({ number, name, path }) => {
      const figure = document.createElement('figure');
      const image = Object.assign(document.createElement('img'), { src: `frame?number=${number}`, alt: name, title: path, loading: 'lazy' });
      const caption = Object.assign(document.createElement('figcaption'), { textContent: name.replace(/\.[^.]*$/, '').replaceAll('_', ' ') });
      image.addEventListener('error', () => { caption.textContent += ': cannot be read as an image'; image.remove(); });
      figure.append(image, caption);
      return figure;
    }));
    const said = (state, words) => {
      const count = frames.filter((one) => one.state === state).length;
      return count ? `${count} of ${frames.length} ${words}` : '';
    };
    const lost = [said('gone', 'are no longer where they were'), said('changed', 'have changed since and are not shown')].filter(Boolean);
    byId('frames-caption').textContent = !frames.length ? 'The record names no frames of this reading.'
      : `${there.length ? 'Frames, the mean of each file, black to white what it holds.' : ''} ${lost.length ? `Of its frames ${lost.join(', ')}.` : ''}`.trim();
  }
}
