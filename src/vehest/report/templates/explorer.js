"use strict";

// Traces, course and filter of a test set. The data are unpacked from 16 bits (report/explorer.py); sideslip is atan2(v, u) with the
// measured u, as everywhere. It is drawn where it is scored and the car moves forward: at standstill it is noise, in reverse it jumps
// between -180 and 180 degrees.

const DEGREES = 180 / Math.PI;
const DRAWN_AT_FIRST = 4;
const DASHES = { solid: [], dashed: [6, 3], dotted: [2, 3], dashdot: [7, 3, 2, 3] };
const HEALTH = ["valid", "degraded", "invalid"];
const COURSE_COLOURS = [[43, 89, 195], [60, 155, 170], [110, 180, 80], [235, 170, 45], [210, 50, 45]];

async function unpack(content) {
  const bytes = Uint8Array.from(atob(content.data), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const raw = new Uint8Array(await new Response(stream).arrayBuffer());
  const n = content.length;
  const columns = {};
  Object.entries(content.columns).forEach(([name, [low, scale]], place) => {
    const values = new Float64Array(n);
    const first = 2 * n * place;
    let code = 0;
    for (let k = 0; k < n; k++) {
      code = (code + raw[first + k] + 256 * raw[first + n + k]) & 0xffff;
      values[k] = code === 0xffff ? NaN : low + scale * code;
    }
    columns[name] = values;
  });
  return columns;
}

// The same angle within a half turn [deg].
function halfTurn(angle) {
  return Math.abs(angle) > 180 ? angle - 360 * Math.round(angle / 360) : angle;
}

function element(tag, properties = {}, ...children) {
  const node = Object.assign(document.createElement(tag), properties);
  node.append(...children);
  return node;
}

// A line breaks where there is no value: between two recordings.
function broken(values) {
  return Array.from(values, (value) => (Number.isNaN(value) ? null : value));
}

function colourOf(name) {
  return getComputedStyle(page).getPropertyValue(`--${name}`).trim();
}

function rounded(value, digits = 3) {
  if (!Number.isFinite(value)) return "\u2013";
  const size = Math.abs(value);
  return value.toFixed(size >= 1000 ? 0 : size >= 100 ? Math.max(digits - 2, 0) : size >= 10 ? Math.max(digits - 1, 0) : digits).replace("-", "\u2212");
}

class Explorer {
  constructor(place, content, columns) {
    Object.assign(this, { place, content, columns });
    this.n = content.length;
    this.time = Float64Array.from({ length: this.n }, (_, k) => content.start + k * content.step);
    this.whole = [this.time[0], this.time[this.n - 1]];
    this.view = [...content.zoom];
    const { vx, vy } = columns;
    this.scored = columns.scored.map((value) => value > 0.5);
    const angles = (v) => v.map((value, k) => (this.scored[k] ? Math.atan2(value, vx[k]) * DEGREES : NaN));
    const forward = (angle) => angle.map((value, k) => (vx[k] >= 0 ? value : NaN));
    const reference = angles(vy);
    this.sideslip = forward(reference);
    this.candidates = content.candidates.map((own, i) => {
      const v = columns[`vy${i}`];
      const angle = angles(v);
      const error = angle.map((value, k) => halfTurn(value - reference[k]));
      const bands = { v: columns[`bandv${i}`], sideslip: columns[`bandb${i}`] };
      return { ...own, i, v, sideslip: forward(angle), error, bands, health: columns[`health${i}`], drawn: i < DRAWN_AT_FIRST };
    });
    this.detail = this.candidates[0];
    this.inputs = content.inputs.map((own, i) => ({ ...own, values: columns[`input${i}`] }));
    this.passes = new Uint8Array(this.n);
    this.sync = uPlot.sync(`explorer-${Explorer.count++}`);
    this.plots = [];
    this.build();
    this.filter();
    this.drawPlots();
    onTheme.push(() => this.drawPlots());
    new ResizeObserver(() => this.resize()).observe(this.panels);
  }

  // The parts of the page: controls, legend and panels, then errors over chosen rows and the course

  build() {
    this.table = element("tbody");
    const head = ["", "estimator (chosen seed)", "RMSE(β) [deg]", "", "RMSE(v) [m/s]", "band, course"];
    const kinds = ["", "", "number", "length", "number second", ""];
    const headers = head.map((text, i) => element(text ? "th" : "td", { textContent: text, className: kinds[i], ...(text ? { scope: "col" } : {}) }));
    const table = element("table", {}, element("thead", {}, element("tr", {}, ...headers)), this.table);
    this.rows = this.candidates.map((own) => this.rowOf(own));
    this.table.append(...this.rows.map((row) => row.line));
    this.said = element("p", { className: "said" });
    this.said.setAttribute("role", "status");
    const scroll = element("div", { className: "scroll", tabIndex: 0, ariaLabel: "errors over the chosen rows" }, table);
    scroll.setAttribute("role", "region");
    const board = element("div", { className: "board" }, this.filters(), scroll, this.said);
    const top = element("div", { className: "top" }, board);
    if (this.columns.x) top.append(this.mapPlace());
    this.panels = element("div", { className: "panels" });
    this.legend = element("div", { className: "legend" });
    this.place.append(this.controls(), this.legend, this.panels, top);
  }

  rowOf(own) {
    const drawn = element("input", { type: "checkbox", checked: own.drawn, ariaLabel: `draw ${own.label}` });
    const detail = element("input", { type: "radio", name: `detail-${this.sync.key}`, checked: own === this.detail, ariaLabel: `bands and course of ${own.label}` });
    drawn.addEventListener("change", () => {
      own.drawn = drawn.checked;
      this.drawPlots();
    });
    detail.addEventListener("change", () => {
      this.detail = own;
      this.drawPlots();
    });
    const swatch = element("span", { className: "swatch" });
    swatch.style.borderTopStyle = { solid: "solid", dotted: "dotted" }[own.dash] || "dashed";
    const [sideslip, v] = [element("td", { className: "number" }), element("td", { className: "number second" })];
    const bar = element("span", { className: "fill" });
    const line = element("tr", {}, element("td", {}, drawn), element("td", {}, swatch, own.label), sideslip, element("td", { className: "length" }, bar), v, element("td", {}, detail));
    return { own, line, swatch, sideslip, v, bar };
  }

  filters() {
    const box = element("fieldset", { className: "filters" }, element("legend", { textContent: "Errors over chosen samples" }));
    this.bounds = {};
    const range = (name, text, unit) => {
      const group = element("span", { className: "range" }, element("span", { textContent: text }));
      for (const end of ["from", "to"]) {
        const input = element("input", { type: "number", step: "any", inputMode: "decimal", ariaLabel: `${text} ${end} [${unit}]`, placeholder: end });
        input.addEventListener("input", () => this.filter(true));
        this.bounds[`${name} ${end}`] = input;
        group.append(input);
      }
      group.append(element("span", { className: "unit", textContent: unit }));
      box.append(group);
    };
    range("speed", "speed", "m/s");
    if (this.columns.ay) range("ay", "|ay|", "m/s²");
    this.inView = element("input", { type: "checkbox" });
    this.inView.addEventListener("change", () => this.filter(true));
    box.append(element("label", {}, this.inView, " in view only"));
    const clear = element("button", { type: "button", textContent: "all rows" });
    clear.addEventListener("click", () => {
      Object.values(this.bounds).forEach((input) => (input.value = ""));
      this.inView.checked = false;
      this.filter(true);
    });
    box.append(clear);
    return box;
  }

  mapPlace() {
    this.map = element("canvas", { role: "img", ariaLabel: "course of the car, coloured by the sideslip error" });
    this.mapScale = element("div", { className: "scale" });
    const note = element("p", { className: "note", textContent: this.content.courseNote });
    return element("div", { className: "course" }, this.map, this.mapScale, note);
  }

  controls() {
    const bar = element("div", { className: "views" });
    const add = (text, act, label = text) => {
      const button = element("button", { type: "button", textContent: text, ariaLabel: label });
      button.addEventListener("click", act);
      bar.append(button);
    };
    const { zoom } = this.content;
    const middle = () => (this.view[0] + this.view[1]) / 2;
    const scaled = (factor) => {
      const half = (factor * (this.view[1] - this.view[0])) / 2;
      this.look([middle() - half, middle() + half]);
    };
    const moved = (share) => this.look(this.view.map((end) => end + share * (this.view[1] - this.view[0])));
    add("whole range", () => this.look(this.whole));
    add(`${Math.round(zoom[1] - zoom[0])} s of largest sideslip`, () => this.look(zoom));
    add("\u2212", () => scaled(2), "zoom out");
    add("+", () => scaled(0.5), "zoom in");
    add("\u25c0", () => moved(-0.5), "earlier");
    add("\u25b6", () => moved(0.5), "later");
    bar.append(element("span", { className: "hint", textContent: "Drag over a segment to zoom in, double-click for the whole range; pinch on a touch screen." }));
    const inputs = element("div", { className: "chips" }, element("span", { textContent: "measured:" }));
    for (const signal of this.inputs) {
      const box = element("input", { type: "checkbox", checked: signal.drawn });
      box.addEventListener("change", () => {
        signal.drawn = box.checked;
        this.drawPlots();
      });
      inputs.append(element("label", {}, box, ` ${signal.label}`));
    }
    return element("div", { className: "controls" }, bar, inputs);
  }

  // Which rows count, and the errors over them

  filter(sorted = false) {
    const bound = (name, otherwise) => {
      const input = this.bounds[name];
      return input && input.value !== "" && Number.isFinite(Number(input.value)) ? Number(input.value) : otherwise;
    };
    const [slow, fast] = [bound("speed from", -Infinity), bound("speed to", Infinity)];
    const [low, high] = [bound("ay from", -Infinity), bound("ay to", Infinity)];
    const { vx, ay } = this.columns;
    const filtered = this.inView.checked || Object.values(this.bounds).some((input) => input.value !== "");
    let [count, known, scored] = [0, 0, 0];
    for (let k = 0; k < this.n; k++) {
      const there = !Number.isNaN(this.columns.vy[k]);
      const size = ay ? Math.abs(ay[k]) : 0;
      const seen = !this.inView.checked || (this.time[k] >= this.view[0] && this.time[k] <= this.view[1]);
      this.passes[k] = there && vx[k] >= slow && vx[k] <= fast && (low === -Infinity && high === Infinity ? true : size >= low && size <= high) && seen;
      known += there;
      count += this.passes[k];
      scored += this.passes[k] && this.scored[k];
    }
    this.filtered = filtered;
    for (const row of this.rows) {
      let [sideslip, v] = [0, 0];
      for (let k = 0; k < this.n; k++) {
        if (!this.passes[k]) continue;
        if (this.scored[k]) sideslip += row.own.error[k] ** 2;
        v += (row.own.v[k] - this.columns.vy[k]) ** 2;
      }
      row.rmse = Math.sqrt(sideslip / scored);
      row.sideslip.textContent = rounded(row.rmse);
      row.v.textContent = rounded(Math.sqrt(v / count));
    }
    const sizes = this.rows.map((row) => row.rmse).filter(Number.isFinite).sort((a, b) => a - b);
    const longest = Math.min(sizes.at(-1) || 1, 6 * (sizes[Math.floor(sizes.length / 2)] || 1));
    for (const row of this.rows) row.bar.style.width = `${Number.isFinite(row.rmse) ? Math.min(100, (100 * row.rmse) / longest) : 0}%`;
    if (sorted) this.table.append(...[...this.rows].sort((a, b) => a.rmse - b.rmse).map((row) => row.line));
    const seconds = (count * this.content.step).toFixed(1);
    this.said.textContent = count
      ? `${count} of ${known} samples, ${seconds} s${scored < count ? `, sideslip scored at ${scored}` : ""}${filtered ? "; the intervals of the forest plot are those of all samples" : ""}.`
      : "No sample is chosen.";
    this.plots.forEach((plot) => plot.redraw(false));
    this.drawMap();
  }

  look([start, stop]) {
    const least = 20 * this.content.step;
    const length = Math.min(Math.max(stop - start, least), this.whole[1] - this.whole[0]);
    const middle = (start + stop) / 2;
    const first = Math.min(Math.max(middle - length / 2, this.whole[0]), this.whole[1] - length);
    this.view = [first, first + length];
    this.plots.forEach((plot) => plot.setScale("x", { min: this.view[0], max: this.view[1] }));
    if (this.inView.checked) this.filter(true);
    this.drawMap();
  }

  // Traces

  drawPlots() {
    this.plots.forEach((plot) => plot.destroy());
    this.plots = [];
    this.panels.replaceChildren();
    const dark = isDark();
    this.rows.forEach((row) => (row.swatch.style.borderTopColor = dark ? row.own.dark : row.own.colour));
    const drawn = this.candidates.filter((own) => own.drawn).reverse(); // the first lies on top
    const reference = { label: "reference", colour: colourOf("reference"), width: 4 }; // below the estimates
    const lines = (quantity) => drawn.map((own) => ({ label: own.label, colour: dark ? own.dark : own.colour, dash: DASHES[own.dash], values: own[quantity], width: 1.2 }));
    const panels = [
      { title: "v [m/s]", height: 190, lines: [{ ...reference, values: this.columns.vy }, ...lines("v")], band: this.bandOf("v") },
      { title: "β [deg]", height: 190, lines: [{ ...reference, values: this.sideslip }, ...lines("sideslip")], band: this.bandOf("sideslip") },
      { title: "error of β [deg]", height: 150, lines: lines("error") },
      ...this.healthPanel(),
    ];
    for (const { label, unit, values } of this.inputs.filter((own) => own.drawn)) {
      panels.push({ title: `${label} [${unit}]`, height: 90, lines: [{ label: "", colour: colourOf("soft"), values, width: 1 }] });
    }
    panels.forEach((panel, i) => this.panel(panel, i === panels.length - 1));
    this.drawLegend(reference, [...drawn].reverse());
    this.drawMap();
  }

  drawLegend(reference, drawn) {
    const entry = (label, colour, dash, kind = "") => {
      const swatch = element("span", { className: `swatch ${kind}` });
      swatch.style.borderTopColor = swatch.style.backgroundColor = colour;
      if (!kind) swatch.style.backgroundColor = "transparent";
      swatch.style.borderTopStyle = { solid: "solid", dotted: "dotted" }[dash] || "dashed";
      return element("span", {}, swatch, label);
    };
    const colour = (candidate) => (isDark() ? candidate.dark : candidate.colour);
    const entries = [entry(reference.label, reference.colour, "solid")];
    entries[0].firstChild.style.borderTopWidth = "4px";
    entries.push(...drawn.map((candidate) => entry(candidate.label, colour(candidate), candidate.dash)));
    if (this.bandOf("sideslip")) entries.push(entry(`90 % band of ${this.detail.label}`, colour(this.detail), "solid", "band"));
    this.legend.replaceChildren(...entries);
  }

  bandOf(quantity) {
    const half = this.detail.bands[quantity];
    if (!half || !this.detail.drawn) return null;
    const values = this.detail[quantity];
    const colour = isDark() ? this.detail.dark : this.detail.colour;
    return { low: values.map((value, k) => value - half[k]), high: values.map((value, k) => value + half[k]), fill: `${colour}30` };
  }

  panel({ title, height, lines, band, options = {} }, last) {
    const readout = element("span", { className: "readout" });
    const head = element("div", { className: "head" }, element("strong", { textContent: title }), ...(options.keys || []), readout);
    const box = element("div", { className: "panel" }, head);
    this.panels.append(box);
    const grid = { stroke: colourOf("grid"), width: 1 };
    const axis = { stroke: colourOf("soft"), grid, ticks: { ...grid, size: 4 }, font: "11px system-ui, sans-serif" };
    const series = [{}];
    const data = [this.time];
    const bands = [];
    if (band) {
      for (const edge of [band.high, band.low]) {
        series.push({ stroke: "transparent", width: 0, points: { show: false } });
        data.push(broken(edge));
      }
      bands.push({ series: [1, 2], fill: band.fill });
    }
    const gaps = (_plot, _series, _first, _last, ranges) => ranges.map(([from, to]) => [from - 1, to + 1]); // where points share a pixel, a line joins its ends
    for (const line of lines) {
      series.push({ label: line.label, stroke: line.colour, width: line.width, dash: line.dash, points: { show: false }, gaps });
      data.push(broken(line.values));
    }
    const settings = {
      width: this.width(),
      height: last ? height + 48 : height,
      series,
      bands,
      padding: [6, 18, last ? 0 : 6, 0],
      legend: { show: false },
      cursor: { sync: { key: this.sync.key, scales: ["x", null] }, drag: { x: true, y: false, setScale: false }, points: { show: false }, y: false, bind: { dblclick: () => () => this.look(this.whole) } },
      scales: { x: { time: false, min: this.view[0], max: this.view[1] }, y: { range: (_, low, high) => spread(low, high) }, ...options.scales },
      axes: [{ ...axis, show: last, size: 30, label: this.content.timeLabel, labelSize: 18, labelFont: "12px system-ui, sans-serif" }, { ...axis, size: 52, space: 26, ...options.y }],
      hooks: {
        drawClear: [(plot) => this.shade(plot), ...(options.draw || [])],
        setSelect: [(plot) => this.chosen(plot)],
        setCursor: [(plot) => this.pointed(plot, readout, lines)],
      },
    };
    const plot = new uPlot(settings, data, box);
    this.touch(plot);
    this.plots.push(plot);
  }

  healthPanel() {
    const known = this.candidates.filter((own) => own.health && own.drawn);
    if (!known.length) return [];
    const colours = ["", colourOf("degraded"), colourOf("invalid")];
    const lane = 32; // of which the upper half has the estimator's name
    const draw = (plot) => {
      const { ctx } = plot;
      const [from, to] = [this.indexAt(this.view[0]), this.indexAt(this.view[1])];
      const ratio = devicePixelRatio;
      known.forEach((own, i) => {
        const top = plot.bbox.top + (i + 0.55) * (plot.bbox.height / known.length);
        const height = (0.35 * plot.bbox.height) / known.length;
        ctx.font = `${12 * ratio}px system-ui, sans-serif`;
        ctx.textBaseline = "bottom";
        ctx.textAlign = "left";
        ctx.fillStyle = isDark() ? own.dark : own.colour;
        ctx.fillText(own.label, plot.bbox.left, top - 1 * ratio, plot.bbox.width);
        ctx.fillStyle = colourOf("soft");
        ctx.fillRect(plot.bbox.left, top + height / 2, plot.bbox.width, ratio);
        for (let k = from; k <= to; k++) {
          const status = own.health[k];
          if (!status) continue;
          let end = k;
          while (end < to && own.health[end + 1] === status) end++;
          const left = plot.valToPos(this.time[k], "x", true);
          ctx.fillStyle = colours[status];
          ctx.fillRect(left, top, Math.max(plot.valToPos(this.time[end], "x", true) - left, 1.5 * ratio), height);
          k = end;
        }
      });
    };
    const lines = known.map((own) => ({ label: own.label, colour: "transparent", values: own.health, health: true, width: 0 }));
    const y = { values: () => [], grid: { show: false }, ticks: { show: false } };
    const keys = HEALTH.map((word) => element("span", { className: `key ${word}`, textContent: word }));
    const options = { draw: [draw], scales: { y: { range: [-1, 3] } }, y, keys };
    return [{ title: "sensor health", height: lane * known.length + 12, lines, options }];
  }

  shade(plot) {
    if (!this.filtered) return;
    const { ctx, bbox } = plot;
    const [from, to] = [this.indexAt(this.view[0]), this.indexAt(this.view[1])];
    ctx.fillStyle = colourOf("shade");
    for (let k = from; k <= to; k++) {
      if (this.passes[k]) continue;
      let end = k;
      while (end < to && !this.passes[end + 1]) end++;
      const left = plot.valToPos(this.time[k], "x", true);
      const right = plot.valToPos(this.time[Math.min(end + 1, this.n - 1)], "x", true);
      ctx.fillRect(Math.max(left, bbox.left), bbox.top, Math.min(right, bbox.left + bbox.width) - Math.max(left, bbox.left), bbox.height);
      k = end;
    }
  }

  chosen(plot) {
    const { left, width } = plot.select;
    if (width < 4) return;
    const range = [plot.posToVal(left, "x"), plot.posToVal(left + width, "x")];
    plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    this.look(range);
  }

  pointed(plot, readout, lines) {
    const k = plot.cursor.idx;
    if (k === null || k === undefined) {
      readout.replaceChildren();
      if (plot === this.plots[0]) this.drawMap();
      return;
    }
    const words = [...lines].reverse().map((line) => {
      const value = line.health ? HEALTH[line.values[k]] || "\u2013" : rounded(line.values[k]);
      const text = element("span", { textContent: `${line.label} ${value}` });
      text.style.color = line.health || line.colour === "transparent" ? "" : line.colour;
      return text;
    });
    if (plot === this.plots[0]) {
      words.unshift(element("span", { textContent: `${rounded(this.time[k], 2)} s` }));
      this.drawMap(k);
    }
    readout.replaceChildren(...words);
  }

  touch(plot) {
    const fingers = new Map();
    let start = null;
    const over = plot.over;
    const at = (x) => (x - over.getBoundingClientRect().left) / over.clientWidth;
    const begin = () => (start = { view: [...this.view], places: [...fingers.values()].map(at) });
    const leave = (event) => {
      fingers.delete(event.pointerId);
      begin();
    };
    over.addEventListener("pointerdown", (event) => {
      if (event.pointerType !== "touch") return;
      fingers.set(event.pointerId, event.clientX);
      begin();
    });
    over.addEventListener("pointermove", (event) => {
      if (!fingers.has(event.pointerId)) return;
      fingers.set(event.pointerId, event.clientX);
      const now = [...fingers.values()].map(at);
      if (now.length !== 2) return;
      const length = start.view[1] - start.view[0];
      const [a, b] = start.places.map((share) => start.view[0] + share * length);
      const wide = now[1] - now[0];
      if (Math.abs(wide) < 0.02) return;
      const next = Math.abs((b - a) / wide);
      const first = (a + b) / 2 - (next * (now[0] + now[1])) / 2;
      this.look([first, first + next]);
    });
    for (const name of ["pointerup", "pointercancel", "pointerleave"]) over.addEventListener(name, leave);
  }

  indexAt(time) {
    return Math.min(Math.max(Math.round((time - this.content.start) / this.content.step), 0), this.n - 1);
  }

  width() {
    return Math.max(this.panels.clientWidth, 200);
  }

  resize() {
    const width = this.width();
    this.plots.forEach((plot) => plot.width !== width && plot.setSize({ width, height: plot.height }));
    this.drawMap();
  }

  // The course

  drawMap(pointed = null) {
    if (!this.map) return;
    const ratio = devicePixelRatio;
    const [width, height] = [this.map.clientWidth, this.map.clientHeight];
    if (!width || !height) return;
    this.map.width = width * ratio;
    this.map.height = height * ratio;
    const ctx = this.map.getContext("2d");
    ctx.scale(ratio, ratio);
    const { x, y } = this.columns;
    const [from, to] = [this.indexAt(this.view[0]), this.indexAt(this.view[1])];
    const box = [Infinity, -Infinity, Infinity, -Infinity];
    const sizes = [];
    for (let k = from; k <= to; k++) {
      if (Number.isNaN(x[k])) continue;
      box[0] = Math.min(box[0], x[k]);
      box[1] = Math.max(box[1], x[k]);
      box[2] = Math.min(box[2], y[k]);
      box[3] = Math.max(box[3], y[k]);
      if (this.scored[k]) sizes.push(Math.abs(this.detail.error[k]));
    }
    if (!Number.isFinite(box[0])) return;
    const limit = sizes.sort((a, b) => a - b)[Math.floor(0.95 * (sizes.length - 1))] || 1;
    const margin = 12;
    const scale = Math.min((width - 2 * margin) / Math.max(box[1] - box[0], 1), (height - 2 * margin - 16) / Math.max(box[3] - box[2], 1));
    const px = (value) => width / 2 + scale * (value - (box[0] + box[1]) / 2);
    const py = (value) => (height - 16) / 2 - scale * (value - (box[2] + box[3]) / 2);
    const step = Math.max(1, Math.floor((to - from) / 6000));
    ctx.lineCap = "round";
    for (let k = from; k + step <= to; k += step) {
      if (Number.isNaN(x[k]) || Number.isNaN(x[k + step])) continue;
      const passes = this.passes[k] && this.scored[k];
      ctx.strokeStyle = passes ? courseColour(Math.abs(this.detail.error[k]) / limit) : colourOf("rule");
      ctx.lineWidth = passes ? 3 : 1.5;
      ctx.beginPath();
      ctx.moveTo(px(x[k]), py(y[k]));
      ctx.lineTo(px(x[k + step]), py(y[k + step]));
      ctx.stroke();
    }
    if (pointed !== null && pointed >= from && pointed <= to && !Number.isNaN(x[pointed])) {
      ctx.fillStyle = colourOf("ink");
      ctx.strokeStyle = colourOf("paper");
      ctx.lineWidth = 2;
      ctx.beginPath();
      ctx.arc(px(x[pointed]), py(y[pointed]), 6, 0, 2 * Math.PI);
      ctx.fill();
      ctx.stroke();
    }
    ruler(ctx, scale, width, height);
    this.mapScale.replaceChildren(
      element("span", { textContent: "|error of β|  0" }),
      element("span", { className: "ramp" }),
      element("span", { textContent: `${rounded(limit, 2)}° and more` }),
      element("span", { className: "of", textContent: this.detail.label }),
    );
    this.mapScale.querySelector(".ramp").style.background = `linear-gradient(to right, ${COURSE_COLOURS.map((c) => `rgb(${c})`).join(", ")})`;
  }
}

Explorer.count = 0;

function spread(low, high) {
  if (!Number.isFinite(low) || !Number.isFinite(high)) return [-1, 1];
  const margin = 0.06 * (high - low) || 0.1 * Math.abs(high) || 1;
  return [low - margin, high + margin];
}

function courseColour(share) {
  const place = Math.min(Math.max(share, 0), 1) * (COURSE_COLOURS.length - 1);
  const first = Math.min(Math.floor(place), COURSE_COLOURS.length - 2);
  const mix = COURSE_COLOURS[first].map((part, i) => Math.round(part + (place - first) * (COURSE_COLOURS[first + 1][i] - part)));
  return `rgb(${mix})`;
}

function ruler(ctx, scale, width, height) {
  const wanted = width / 4 / scale;
  const power = 10 ** Math.floor(Math.log10(wanted));
  const length = [5, 2, 1].map((part) => part * power).find((value) => value <= wanted) || power;
  ctx.strokeStyle = ctx.fillStyle = colourOf("soft");
  ctx.lineWidth = 1.5;
  ctx.beginPath();
  ctx.moveTo(12, height - 8);
  ctx.lineTo(12 + length * scale, height - 8);
  ctx.stroke();
  ctx.font = "11px system-ui, sans-serif";
  ctx.fillText(`${length} m`, 18 + length * scale, height - 4);
}

for (const figure of document.querySelectorAll("figure.live")) {
  if (!window.DecompressionStream) break; // an older browser shows the static figure
  const script = figure.querySelector("script");
  const content = JSON.parse(script.textContent);
  script.remove();
  unpack(content).then((columns) => {
    figure.classList.add("drawn");
    delete content.data;
    figure.explorer = new Explorer(figure.querySelector(".explorer"), content, columns);
    figure.dataset.ready = "yes";
  });
}
