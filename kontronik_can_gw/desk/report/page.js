"use strict";
// The page of one flight: plots by uPlot with one common time range and cursor, a band of operating states, the list of events.
// Times are seconds of the recording. Text of the input only ever becomes text nodes.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const byId = (id) => document.getElementById(id);
  const root = document.documentElement;
  const several = data.escs.length > 1;
  const whole = [data.from, Math.max(data.to, data.from + 0.1)];
  const LEAST_SPAN = 0.05;
  const AXIS = 58;
  const ROW = 15; // height of a row of text above a plot
  const WIDTHS = [2, 1.2, 0.8]; // of a plot's lines, where colours and dashes tell ESCs apart

  // --- small tools

  function make(tag, attributes = {}, ...children) {
    const node = document.createElement(tag);
    for (const [key, value] of Object.entries(attributes)) {
      if (key === "class") node.className = value;
      else node.setAttribute(key, value);
    }
    node.append(...children);
    return node;
  }

  function bytes(base64) {
    const text = atob(base64);
    const found = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) found[i] = text.charCodeAt(i);
    return found.buffer;
  }

  // Values of a line; null where not available.
  function values(line) {
    const type = { i16: Int16Array, i32: Int32Array, f64: Float64Array }[line.type];
    const none = { i16: -32768, i32: -2147483648, f64: NaN }[line.type];
    const scale = line.scale ?? 1;
    return Array.from(new type(bytes(line.data)), (v) => (v === none || v !== v ? null : v / scale));
  }

  function clock(t, digits = 1) {
    const steps = Math.round(Math.abs(t) * 10 ** digits);
    const s = Math.floor(steps / 10 ** digits);
    const part = digits ? "." + String(steps % 10 ** digits).padStart(digits, "0") : "";
    const two = (n) => String(n).padStart(2, "0");
    const [h, m] = [Math.floor(s / 3600), Math.floor(s / 60) % 60];
    return (t < 0 ? "−" : "") + (h ? `${h}:${two(m)}` : m) + ":" + two(s % 60) + part;
  }

  function shown(value, digits) {
    if (value === null || value === undefined) return "–";
    return value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits })
      .replaceAll(",", "\u202f").replace("-", "−");
  }

  // --- colours

  const dark = () => root.classList.contains("dark");
  const ink = (name) => getComputedStyle(root).getPropertyValue(name).trim();
  const styleOf = (index) => data.styles[index % data.styles.length];
  const colour = (index) => styleOf(index)[dark() ? "dark" : "light"];
  // Of several ESCs each has its colour and dashes; of one alone, each line of a plot.
  const styleIndex = (line) => (several ? line.esc : line.line);

  // A sample of a line; of style null only its width counts.
  function swatch(index, width = 2) {
    const ns = "http://www.w3.org/2000/svg";
    const svg = document.createElementNS(ns, "svg");
    const stroke = document.createElementNS(ns, "line");
    svg.setAttribute("class", "swatch");
    svg.setAttribute("viewBox", "0 0 26 8");
    svg.setAttribute("aria-hidden", "true");
    for (const [key, value] of Object.entries({ x1: 0, x2: 26, y1: 4, y2: 4, "stroke-width": width + 0.6 })) {
      stroke.setAttribute(key, value);
    }
    if (index === null) {
      stroke.setAttribute("stroke", "currentColor");
    } else {
      if (styleOf(index).dash.length) stroke.setAttribute("stroke-dasharray", styleOf(index).dash.join(" "));
      stroke.setAttribute("stroke", colour(index));
      stroke.dataset.style = index;
    }
    svg.append(stroke);
    return svg;
  }

  function setTheme(isDark) {
    root.classList.toggle("dark", isDark);
    for (const stroke of document.querySelectorAll("[data-style]")) stroke.setAttribute("stroke", colour(+stroke.dataset.style));
    for (const patch of document.querySelectorAll("[data-class]")) patch.style.background = classColour(+patch.dataset.class);
    for (const plot of plots) plot.u.redraw(false, true);
  }

  const classColour = (index) => data.classes[index][dark() ? "dark" : "light"];

  // --- what is shown

  const plots = [];
  const visible = data.escs.map(() => true);
  let range = [...whole];
  let cursorTime = null;

  function setRange(from, to) {
    const span = Math.min(Math.max(to - from, LEAST_SPAN), whole[1] - whole[0]);
    const begin = Math.min(Math.max((from + to - span) / 2, whole[0]), whole[1] - span);
    const fits = span === to - from && from >= whole[0] && to <= whole[1]; // then not a bit of it is changed
    range = fits ? [from, to] : [begin, begin + span];
    for (const plot of plots) {
      plot.isStale = true;
      if (plot.isNear) follow(plot);
    }
  }

  // Plots far off the screen take the range when they come near: many ESCs would be slow to draw otherwise.
  function follow(plot) {
    if (!plot.isStale) return;
    plot.isStale = false;
    plot.u.setScale("x", { min: range[0], max: range[1] });
  }

  const followAll = () => plots.forEach(follow);
  const nearness = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      const plot = plots.find(({ box }) => box === entry.target);
      plot.isNear = entry.isIntersecting;
      if (plot.isNear) follow(plot);
    }
  }, { rootMargin: "400px" });

  const zoom = (factor, about = (range[0] + range[1]) / 2) =>
    setRange(about - (about - range[0]) * factor, about + (range[1] - about) * factor);
  const pan = (share) => setRange(range[0] + share * (range[1] - range[0]), range[1] + share * (range[1] - range[0]));

  // The cursor of every plot at a time; null: nowhere.
  function setCursor(t) {
    for (const { u } of plots) {
      u.setCursor(t === null ? { left: -10, top: -10 } : { left: u.valToPos(t, "x"), top: u.over.clientHeight / 2 });
    }
  }

  function goTo(from, to = from) {
    const pad = Math.max(2.5, (to - from) / 4);
    setRange(from - pad, to + pad);
    byId("plots").scrollIntoView({ block: "start" });
    setCursor(from);
  }

  // --- marks of errors

  const errors = data.events.filter((event) => event.kind === "error");

  const numberOf = new Map(errors.map((event, index) => [event, index + 1]));
  const ROWS = Math.min(4, errors.length);
  const TEXTS = ROWS * ROW + 2;
  const MOST_MARKS = 60; // with a text or a number
  const MOST_TOLD = 12; // lines below a plot
  const textOf = (event) => (several ? data.escs[event.esc] + ": " : "") + event.text;
  const toneOf = (event) => ink({ error: "--error", warning: "--warning" }[event.severity] ?? "--soft");

  function drawMarks(u, withText) {
    const { ctx, bbox } = u;
    const ratio = devicePixelRatio || 1;
    const right = bbox.left + bbox.width;
    const shadedTo = {}; // by severity: where several overlap it is not darker
    const lastLine = {}; // by severity
    ctx.save();
    ctx.beginPath();
    const above = withText ? TEXTS * ratio : 0; // the texts stand above the data, never over them
    ctx.rect(bbox.left, bbox.top - above, bbox.width, bbox.height + above);
    ctx.clip();
    ctx.font = `${11 * ratio}px system-ui, sans-serif`;
    ctx.textBaseline = "top";
    ctx.textAlign = "left";
    ctx.lineWidth = ratio;
    for (const event of errors) {
      const end = event.to ?? whole[1];
      if (!visible[event.esc] || end < range[0] || event.from > range[1]) continue;
      const x = u.valToPos(event.from, "x", true);
      const xEnd = u.valToPos(end, "x", true);
      const tone = toneOf(event);
      ctx.strokeStyle = ctx.fillStyle = tone;
      const shade = Math.max(x, bbox.left, shadedTo[event.severity] ?? 0);
      if (withText && xEnd > shade) {
        ctx.globalAlpha = 0.08;
        ctx.fillRect(shade, bbox.top, Math.min(xEnd, right) - shade, bbox.height);
        shadedTo[event.severity] = xEnd;
      }
      ctx.globalAlpha = 0.8;
      if (!(x - lastLine[event.severity] < ratio)) {
        line(ctx, x, bbox, event.severity === "error" ? [] : [6 * ratio, 3 * ratio]);
        lastLine[event.severity] = x;
      }
      if (event.to !== null) {
        ctx.globalAlpha = 0.45;
        line(ctx, xEnd, bbox, [ratio, 3 * ratio]);
      }
    }
    if (withText) drawLabels(u, ratio);
    ctx.restore();
  }

  // Where the texts of the marks in sight stand, in rows above the plot: each begins at its mark, and no mark's line runs through
  // a text. Where not all find room each mark has a number, and what still finds room its text; who is without is told below.
  function layOut(marks, from, to, rows, step) {
    const taken = Array.from({ length: rows }, () => []);
    const lines = Array.from({ length: rows }, () => []); // that lead from a mark up to its text
    const isFree = (row, left, right) => taken[row].every((span) => right <= span[0] || left >= span[1]);
    const put = (mark, first) => {
      const [left, right] = [mark.left + 4 * step, mark.left + mark.width + 10 * step];
      for (let row = first; right <= to && row < rows; row++) {
        if (!isFree(row, left, right) || lines[row].some((x) => x > left && x < right)) continue;
        for (let at = 0; at < row && mark.x >= from; at++) if (!isFree(at, mark.x - step, mark.x + step)) return false;
        taken[row].push([left, right]);
        for (let at = 0; at < row && mark.x >= from; at++) lines[at].push(mark.x);
        mark.text = { row, left, right };
        return true;
      }
      return false;
    };
    const backwards = [...marks].reverse(); // an earlier text that has no room beside a later one stands above it
    if (backwards.map((mark) => put(mark, 0)).every(Boolean)) return;
    for (const found of [...taken, ...lines]) found.splice(0);
    for (const mark of marks) {
      mark.text = null;
      let left = Math.min(mark.left + 2 * step, to - mark.badge);
      const last = left + 3 * mark.badge;
      while (left <= last && !isFree(0, left, left + mark.badge)) left += step;
      if (left > last || left + mark.badge > to) continue;
      mark.number = { row: 0, left, right: left + mark.badge };
      taken[0].push([left, left + mark.badge]);
    }
    for (const kind of ["error", "warning", "status"]) {
      for (const mark of backwards) if (mark.event.severity === kind) put(mark, 1);
    }
  }

  function drawLabels(u, ratio) {
    const { ctx, bbox } = u;
    const [from, to] = [bbox.left, bbox.left + bbox.width];
    const seen = errors.filter((event) => visible[event.esc] && (event.to ?? whole[1]) >= range[0] && event.from <= range[1]);
    const rank = (event) => ["error", "warning", "status"].indexOf(event.severity);
    const chosen = seen.length <= MOST_MARKS ? seen
      : [...seen].sort((a, b) => rank(a) - rank(b)).slice(0, MOST_MARKS).sort((a, b) => a.from - b.from);
    const marks = chosen.map((event) => {
      const x = u.valToPos(event.from, "x", true);
      const number = String(numberOf.get(event));
      return {
        event, x, left: Math.max(x, from), width: ctx.measureText(textOf(event)).width,
        badge: ctx.measureText(number).width + 6 * ratio, text: null, number: null,
      };
    });
    layOut(marks, from, to, ROWS, ratio);
    ctx.globalAlpha = 1;
    ctx.setLineDash([]);
    for (const { event, x, text, number } of marks) {
      ctx.fillStyle = ctx.strokeStyle = toneOf(event);
      if (number) {
        ctx.fillRect(number.left, bbox.top - ROW * ratio, number.right - number.left - ratio, (ROW - 1) * ratio);
        ctx.fillStyle = ink("--card");
        ctx.fillText(numberOf.get(event), number.left + 2.5 * ratio, bbox.top - (ROW - 1) * ratio);
        ctx.fillStyle = toneOf(event);
      }
      if (text) {
        ctx.fillText(textOf(event), text.left, bbox.top - (ROW * (text.row + 1) - 1) * ratio);
        if (x >= from) ctx.fillRect(x - ratio / 2, bbox.top - ROW * (text.row + 1) * ratio, ratio, ROW * (text.row + 1) * ratio);
      }
    }
    const plot = plots.find((found) => found.u === u);
    if (!plot) return; // its first drawing: it is drawn again when it takes the range
    plot.marks = marks.map(({ event, x, text, number }) => ({ event, x, text, number }));
    tellBelow(plot, marks.filter((mark) => !mark.text).map((mark) => mark.event), seen.length - marks.length);
  }

  // What has no text at its mark: the numbers, and the text.
  function tellBelow(plot, events, more) {
    const groups = new Map();
    for (const event of events) {
      const key = `${event.severity} ${textOf(event)}`;
      groups.set(key, [...(groups.get(key) ?? []), event]);
    }
    const told = [...groups.values()].slice(0, MOST_TOLD);
    const left = more + events.length - told.flat().length;
    const key = JSON.stringify([told.map((group) => group.map((event) => numberOf.get(event))), left]);
    if (plot.told === key) return;
    plot.told = key;
    plot.below.hidden = !told.length && !left;
    const lines = told.map((group) => make("li", { class: group[0].severity },
      make("b", {}, group.slice(0, 8).map((event) => numberOf.get(event)).join(", ") + (group.length > 8 ? " …" : "")),
      ` ${textOf(group[0])} (${clock(group[0].from)}${group.length > 1 ? " …" : ""})`));
    if (left > 0) lines.push(make("li", {}, `${left} more: zoom in, or see the events`));
    plot.below.replaceChildren(...lines);
  }

  function line(ctx, x, bbox, dash) {
    ctx.setLineDash(dash);
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
  }

  // --- plots

  const STEPS = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600,
    7200, 14400, 28800, 86400];
  const times = Array.from(new Float64Array(bytes(data.times)));

  function timeLabels(u, splits) {
    const step = splits.length > 1 ? splits[1] - splits[0] : 1;
    const digits = step >= 0.999 ? 0 : step >= 0.0999 ? 1 : step >= 0.00999 ? 2 : 3;
    return splits.map((t) => clock(t, digits));
  }

  function axes(more = {}) {
    const common = {
      stroke: () => ink("--soft"),
      grid: { stroke: () => ink("--grid"), width: 1 },
      ticks: { stroke: () => ink("--grid"), width: 1, size: 5 },
      font: "11px system-ui, sans-serif",
    };
    return [
      { ...common, incrs: STEPS, values: timeLabels, space: 70, size: 28 },
      { ...common, size: AXIS, space: 32, values: (u, splits) => splits.map((v) => v.toLocaleString("en").replaceAll(",", "\u202f")), ...more },
    ];
  }

  // Whether the cursor stands between the point next to it and one without a value: the former is not for its time.
  function inGap(u, column, index) {
    const t = u.posToVal(u.cursor.left, "x");
    if (Math.abs(u.valToPos(times[index], "x") - u.cursor.left) <= 3) return false;
    return (column[t < times[index] ? index - 1 : index + 1] ?? null) === null;
  }

  function isolated(line) {
    const found = [];
    line.forEach((v, i) => {
      if (v !== null && (line[i - 1] ?? null) === null && (line[i + 1] ?? null) === null) found.push(i);
    });
    return found;
  }

  function addPlot(figure, label, height, series, columns, more) {
    const box = make("div", { class: "plot", tabindex: "0", role: "group", "aria-label": `${label} over time` });
    const below = make("ul", { class: "marks", hidden: "" });
    figure.append(box, below);
    const plot = { u: null, box, below, marks: [], height, isNear: true, isStale: false, showCursor: () => {} };
    const options = {
      width: Math.max(200, box.clientWidth),
      height,
      legend: { show: false },
      padding: [more.draw || !errors.length ? 8 : TEXTS + 4, 10, 0, 0],
      scales: { x: { time: false, range: (u, from, to) => [from, to] }, ...more.scales },
      axes: more.axes ?? axes(),
      series: [{}, ...series],
      cursor: {
        y: false,
        drag: { x: true, y: false, dist: 4 },
        points: { size: 7 },
        sync: { key: "time", setSeries: false, filters: { pub: (type) => type === "mousemove" || type === "mouseleave" } },
        bind: { dblclick: () => () => (setRange(...whole), null) },
      },
      hooks: {
        setScale: [(u, key) => {
          const { min, max } = u.scales.x;
          const isOurs = plot.isStale || (min === range[0] && max === range[1]);
          if (key === "x" && !isOurs && plots.includes(plot)) queueMicrotask(() => setRange(min, max));
        }],
        setCursor: [(u) => {
          plot.showCursor(u);
          later(u.cursor.left >= 0 ? u.posToVal(u.cursor.left, "x") : null);
        }],
        draw: [...(more.draw ? [more.draw] : []), (u) => drawMarks(u, !more.draw)],
      },
    };
    plot.u = new uPlot(options, [times, ...columns], box);
    plots.push(plot);
    plot.u.setScale("x", { min: whole[0], max: whole[1] });
    nearness.observe(box);
    listen(plot);
    return plot;
  }

  function addLines(spec) {
    const caption = make("figcaption", {}, make("h3", {}, spec.title + " ", make("small", {}, spec.unit)));
    const figure = make("figure", { id: "plot-" + spec.key }, caption);
    byId("plots").append(figure);
    const columns = spec.series.map(values);
    const lines = spec.lines.map(() => true); // shown or not
    const series = spec.series.map((line, index) => {
      const single = isolated(columns[index]);
      const tone = () => colour(styleIndex(line));
      return {
        label: spec.lines[line.line],
        stroke: tone,
        width: several ? WIDTHS[line.line] : 1.6,
        alpha: several ? [1, 0.75, 0.6][line.line] ?? 1 : 1,
        dash: styleOf(styleIndex(line)).dash,
        spanGaps: false,
        points: { show: single.length > 0, size: 4, fill: tone, filter: () => single },
      };
    });
    const scales = {
      y: {
        range: (u, low, high) => {
          if (low === null || low === undefined || low === Infinity) return [0, 1];
          const pad = (high - low || Math.max(Math.abs(high), 1) * 0.1) * 0.08;
          return [low - pad < 0 && low >= 0 && low < high / 3 ? 0 : low - pad, high + pad];
        },
      },
    };
    const plot = addPlot(figure, spec.title, (innerWidth < 720 ? 180 : 220) + (errors.length ? TEXTS : 0), series, columns, { scales });
    plot.key = spec.key;

    // legend: a row for each line, of several ESCs a column for each
    const used = [...new Set(spec.series.map((line) => line.line))].sort();
    const escs = [...new Set(spec.series.map((line) => line.esc))];
    const cells = spec.series.map(() => make("td", {}, "–"));
    const columnsOf = [];
    const rows = used.map((index) => {
      const sample = several ? swatch(null, WIDTHS[index]) : swatch(index);
      const button = make("button", { type: "button", "aria-pressed": "true" }, sample, spec.lines[index]);
      button.addEventListener("click", () => {
        lines[index] = !lines[index];
        button.setAttribute("aria-pressed", lines[index]);
        plot.showLines();
      });
      const row = make("tr", {}, make("th", { scope: "row" }, button));
      for (const esc of escs) {
        const found = spec.series.findIndex((line) => line.esc === esc && line.line === index);
        const cell = cells[found] ?? make("td");
        columnsOf.push([esc, cell]);
        row.append(cell);
      }
      return row;
    });
    const head = make("tr", {}, make("td"), ...escs.map((esc) => {
      const cell = make("th", { scope: "col" }, swatch(esc), " ", data.escs[esc]);
      columnsOf.push([esc, cell]);
      return cell;
    }));
    caption.append(make("div", { class: "scroll" }, make("table", { class: several ? "legend" : "legend single" },
      ...(several ? [make("thead", {}, head)] : []), make("tbody", {}, ...rows))));

    plot.showLines = () => {
      plot.u.batch(() => spec.series.forEach((line, index) => {
        const show = visible[line.esc] && lines[line.line];
        if (plot.u.series[index + 1].show !== show) plot.u.setSeries(index + 1, { show });
      }));
      for (const [esc, cell] of columnsOf) cell.hidden = !visible[esc];
      plot.u.redraw(false);
    };
    plot.showCursor = (u) => {
      const index = u.cursor.left >= 0 ? u.cursor.idx : null;
      cells.forEach((cell, i) => {
        cell.textContent = index === null || index === undefined || inGap(u, columns[i], index) ? "–" : shown(columns[i][index], spec.digits);
      });
    };
  }

  // --- the band of operating states

  function stateAt(esc, t) {
    const segments = data.segments[esc];
    let [low, high] = [0, segments.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (segments[middle][0] <= t) low = middle + 1;
      else high = middle;
    }
    const found = segments[low - 1];
    return found && t <= found[1] ? found : null;
  }

  function addBand() {
    const rows = data.escs.map((_, esc) => esc).filter((esc) => data.segments[esc].length);
    if (!rows.length) return;
    const caption = make("figcaption", {}, make("h3", {}, "Operating state"));
    const figure = make("figure", { id: "plot-states" }, caption);
    byId("plots").append(figure);

    function draw(u) {
      const { ctx, bbox } = u;
      const ratio = devicePixelRatio || 1;
      const height = bbox.height / rows.length;
      ctx.save();
      ctx.font = `${11 * ratio}px system-ui, sans-serif`;
      ctx.textBaseline = "middle";
      ctx.textAlign = "right";
      ctx.fillStyle = ink("--soft");
      rows.forEach((esc, row) => {
        let name = data.escs[esc];
        while (name.length > 1 && ctx.measureText(name).width > (AXIS - 8) * ratio) name = name.replace(/.…?$/u, "…");
        ctx.fillText(name, bbox.left - 6 * ratio, bbox.top + (row + 0.5) * height);
      });
      ctx.textAlign = "left";
      ctx.beginPath();
      ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
      ctx.clip();
      rows.forEach((esc, row) => {
        ctx.globalAlpha = visible[esc] ? 1 : 0.2;
        const top = bbox.top + row * height + ratio;
        for (const [from, to, state] of data.segments[esc]) {
          if (to < range[0] || from > range[1]) continue;
          const [name, group] = data.states[state];
          const left = Math.max(u.valToPos(from, "x", true), bbox.left);
          const width = Math.min(u.valToPos(to, "x", true), bbox.left + bbox.width) - left;
          ctx.fillStyle = classColour(group);
          ctx.fillRect(left, top, Math.max(width, ratio), height - 2 * ratio);
          if (width > 30 * ratio && ctx.measureText(name).width < width - 8 * ratio) {
            ctx.fillStyle = ink("--ink");
            ctx.fillText(name, left + 4 * ratio, top + height / 2 - ratio);
          }
          if (width > 4 * ratio) {
            ctx.fillStyle = ink("--card");
            ctx.fillRect(left, top, ratio, height - 2 * ratio);
          }
        }
      });
      ctx.restore();
    }

    const flat = new Array(times.length).fill(null);
    const [time, side] = axes({ splits: () => [], grid: { show: false }, ticks: { show: false } });
    const plot = addPlot(figure, "Operating state", 38 + 26 * rows.length, [{ points: { show: false } }], [flat], {
      scales: { y: { range: () => [0, rows.length] } },
      axes: [{ ...time, grid: { show: false } }, side],
      draw,
    });
    plot.key = "states";
    plot.showLines = () => plot.u.redraw(false);

    const texts = rows.map((esc) => ({ esc, text: make("span", {}, "–") }));
    caption.append(make("div", { class: "band" }, ...texts.map(({ esc, text }) =>
      make("span", {}, ...(several ? [make("small", {}, data.escs[esc] + " ")] : []), text))));
    plot.showCursor = (u) => {
      const t = u.cursor.left >= 0 ? u.posToVal(u.cursor.left, "x") : null;
      for (const { esc, text } of texts) {
        const found = t === null ? null : stateAt(esc, t);
        const when = found && !several ? ` (${clock(found[0])} to ${clock(found[1])})` : "";
        text.textContent = found ? data.states[found[2]][0] + when : "–";
      }
    };
    const met = [...new Set(Object.values(data.states).map(([, group]) => group))].sort((a, b) => a - b);
    figure.append(make("ul", { class: "states" }, ...met.map((group) => {
      const patch = make("i", { "data-class": group });
      patch.style.background = classColour(group);
      return make("li", {}, patch, data.classes[group].label);
    })));
  }

  // --- pointer, fingers, keys

  function listen({ u, box }) {
    const over = u.over;
    const timeAt = (x) => u.posToVal(x - over.getBoundingClientRect().left, "x");
    over.addEventListener("wheel", (event) => {
      const sideways = event.shiftKey ? event.deltaY || event.deltaX : event.deltaX;
      if (event.ctrlKey || event.metaKey) zoom(Math.exp(Math.max(-60, Math.min(60, event.deltaY)) * 0.006), timeAt(event.clientX));
      else if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)) pan(Math.sign(sideways) * 0.1);
      else return;
      event.preventDefault();
    }, { passive: false });

    const fingers = new Map();
    let held = null; // times below the two fingers when they came down
    over.addEventListener("pointerdown", (event) => {
      if (event.pointerType !== "touch") return;
      fingers.set(event.pointerId, event.clientX);
      held = fingers.size === 2 ? [...fingers.values()].map(timeAt).sort((a, b) => a - b) : null;
    });
    over.addEventListener("pointermove", (event) => {
      if (!fingers.has(event.pointerId)) return;
      fingers.set(event.pointerId, event.clientX);
      if (fingers.size === 1) setCursor(timeAt(event.clientX));
      if (!held) return;
      const { left, width } = over.getBoundingClientRect();
      const [a, b] = [...fingers.values()].map((x) => (x - left) / width).sort((p, q) => p - q);
      const span = (held[1] - held[0]) / Math.max(b - a, 0.02);
      setRange(held[0] - a * span, held[0] + (1 - a) * span);
    });
    for (const kind of ["pointerup", "pointercancel", "pointerleave"]) {
      over.addEventListener(kind, (event) => {
        fingers.delete(event.pointerId);
        held = null;
      });
    }

    box.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const step = (range[1] - range[0]) / 100;
      const about = cursorTime ?? (range[0] + range[1]) / 2;
      const move = (by) => setCursor(Math.min(Math.max(about + by, range[0]), range[1]));
      const actions = {
        ArrowLeft: () => (event.shiftKey ? pan(-0.1) : move(-step)),
        ArrowRight: () => (event.shiftKey ? pan(0.1) : move(step)),
        "+": () => zoom(0.6, about),
        "=": () => zoom(0.6, about),
        "-": () => zoom(1 / 0.6, about),
        0: () => setRange(...whole),
        Home: () => setCursor(range[0]),
        End: () => setCursor(range[1]),
        Escape: () => setCursor(null),
      };
      if (!actions[event.key]) return;
      event.preventDefault();
      actions[event.key]();
    });
  }

  // --- the line that says where the cursor is

  let asked = false;
  function later(t) {
    cursorTime = t;
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      showNow();
    });
  }

  function showNow() {
    const now = byId("now");
    const span = `${clock(range[0])} to ${clock(range[1])}`;
    if (cursorTime === null) {
      now.replaceChildren(span);
      return;
    }
    const t = cursorTime;
    const parts = [clock(t, 2)];
    if (data.wall !== null) parts.push(" · " + new Date(data.wall + t * 1000).toISOString().slice(11, 21) + " UTC");
    const reach = (range[1] - range[0]) / 400;
    for (const event of errors) {
      if (!visible[event.esc] || event.from - reach > t || (event.to ?? whole[1]) + reach < t) continue;
      parts.push(" · ", make("span", { class: event.severity }, textOf(event)));
      if (parts.length > 10) break;
    }
    now.replaceChildren(...parts);
  }

  // --- ESCs, buttons

  function addEscs() {
    if (!several) return;
    data.escs.forEach((name, esc) => {
      const button = make("button", { type: "button", "aria-pressed": "true", "data-esc": esc }, swatch(esc), name);
      button.addEventListener("click", () => {
        visible[esc] = !visible[esc];
        button.setAttribute("aria-pressed", visible[esc]);
        for (const plot of plots) plot.showLines();
        listEvents();
        showNow();
      });
      byId("escs").append(button);
    });
  }

  byId("back").addEventListener("click", () => pan(-0.3));
  byId("forth").addEventListener("click", () => pan(0.3));
  byId("in").addEventListener("click", () => zoom(0.5));
  byId("out").addEventListener("click", () => zoom(2));
  byId("all").addEventListener("click", () => setRange(...whole));
  byId("theme").addEventListener("click", () => setTheme(!dark()));
  for (const button of document.querySelectorAll("[data-at]")) {
    button.addEventListener("click", () => goTo(+button.dataset.at));
  }

  // --- events

  const KINDS = { error: "Errors", state: "States", link: "Link", device: "Device" };
  const words = { error: "Error", warning: "Warning", status: "Status" };
  const kindText = (event) => (event.kind === "error" ? words[event.severity] ?? "Error" : { state: "State", link: "Link", device: "Device" }[event.kind]);
  const end = (event) => (event.momentary ? event.from : event.to ?? whole[1]);
  const sorts = {
    from: (e) => e.from,
    length: (e) => end(e) - e.from,
    esc: (e) => e.esc,
    kind: (e) => kindText(e),
    text: (e) => e.text,
  };
  const chosen = new Set(Object.keys(KINDS));
  let sorting = ["from", 1];
  let most = 200;

  function lengthText(event) {
    if (event.momentary) return "";
    const length = `${(end(event) - event.from).toFixed(1)} s`;
    return event.to === null ? `${length}, to the end` : length;
  }

  function listEvents() {
    const needle = byId("search").value.trim().toLowerCase();
    const text = (e) => `${e.text} ${kindText(e)} ${data.escs[e.esc]} ${e.remedy} ${e.note}`.toLowerCase();
    const found = data.events.filter((e) => chosen.has(e.kind) && visible[e.esc] && (!needle || text(e).includes(needle)));
    const key = sorts[sorting[0]];
    found.sort((a, b) => (key(a) < key(b) ? -1 : key(a) > key(b) ? 1 : a.from - b.from) * sorting[1]);
    byId("count").textContent = `${found.length} of ${data.events.length}`;
    byId("more").hidden = found.length <= most;
    byId("events").tBodies[0].replaceChildren(...found.slice(0, most).map((event) => {
      const time = make("button", { type: "button", class: "at" }, clock(event.from, 2));
      const row = make("tr", { class: event.kind === "error" || event.severity === "error" ? event.severity : event.kind },
        make("td", {}, time),
        make("td", {}, lengthText(event)),
        make("td", {}, data.escs[event.esc]),
        make("td", {}, kindText(event)),
        make("td", { class: "what" }, event.text + (event.note ? ` (${event.note})` : "")),
        make("td", { class: "do" }, event.remedy));
      row.addEventListener("click", () => goTo(event.from, end(event)));
      return row;
    }));
  }

  function addFilters() {
    for (const [kind, label] of Object.entries(KINDS)) {
      const count = data.events.filter((event) => event.kind === kind).length;
      if (!count) continue;
      const button = make("button", { type: "button", "aria-pressed": "true", "data-kind": kind }, `${label} ${count}`);
      button.addEventListener("click", () => {
        if (!chosen.delete(kind)) chosen.add(kind);
        button.setAttribute("aria-pressed", chosen.has(kind));
        listEvents();
      });
      byId("kinds").append(button);
    }
    byId("search").addEventListener("input", listEvents);
    byId("more").addEventListener("click", () => {
      most += 1000;
      listEvents();
    });
    for (const button of document.querySelectorAll("[data-sort]")) {
      button.addEventListener("click", () => {
        sorting = [button.dataset.sort, sorting[0] === button.dataset.sort ? -sorting[1] : 1];
        for (const head of byId("events").tHead.rows[0].cells) head.removeAttribute("aria-sort");
        button.parentElement.setAttribute("aria-sort", sorting[1] > 0 ? "ascending" : "descending");
        listEvents();
      });
    }
  }

  // --- begin

  root.classList.toggle("dark", matchMedia("(prefers-color-scheme: dark)").matches);
  addEscs();
  addBand();
  for (const spec of data.plots) addLines(spec);
  addFilters();
  listEvents();
  showNow();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", (event) => setTheme(event.matches));

  const fit = (width) => {
    for (const { u, box, height } of plots) {
      const wanted = width ?? box.clientWidth;
      if (wanted > 0 && wanted !== u.width) u.setSize({ width: wanted, height });
    }
  };
  new ResizeObserver(() => fit()).observe(byId("plots"));
  let before = null;
  addEventListener("beforeprint", () => {
    before = dark();
    followAll();
    setTheme(false);
    fit(680);
  });
  addEventListener("afterprint", () => {
    setTheme(before);
    fit();
  });

  // For who wants to look at the data from the console, and for the tests.
  globalThis.flight = { data, plots, setRange, setCursor, goTo, followAll, range: () => [...range] };
})();
