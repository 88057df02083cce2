"use strict";
// Plots over time by uPlot, with one common time range and cursor, for the report and the live page.
// Other scripts of a page use the functions of this file. Text of the input becomes only text nodes,
// so it cannot inject HTML.

const byId = (id) => document.getElementById(id);
const root = document.documentElement;
const narrow = innerWidth < 720;
const MIN_SPAN = 0.05;
const AXIS = narrow ? 48 : 58;
const LETTER = 6.6; // width of a digit in an axis label
const RIGHT = 34; // room for half of the last time label
const COLOURS = 8;
const DASHES = { solid: [], dashed: [8, 4], dotted: [2, 3] }; // by the style of a border in CSS
const FONT = "11px system-ui, sans-serif";
const WIDTHS = [2, 1.2, 0.8]; // of a plot's lines, where colours and dashes tell ESCs apart
const SAMPLE_WIDTHS = [4, 2, 1]; // of the same lines in the legend, in whole pixels

function make(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  node.append(...children);
  return node;
}

// With several ESCs, each ESC has its own colour and dashes. With one ESC, each line of a plot has.
const colour = (style) => `--c${style % COLOURS}`;
const dashes = (style) => Object.keys(DASHES)[style % 3];
const withSpaces = (text) => text.replaceAll(",", "\u202f").replace("-", "−");
const ink = (name) => getComputedStyle(root).getPropertyValue(name).trim();

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
  return withSpaces(value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits }));
}

// Makes the plots of the element #plots. `data` has `escs` (names), `times` (seconds) and `errors`,
// which may be replaced later. `whole` is the widest time range. `showNow` is called after a change
// of the range or the cursor.
function timePlots(data, whole, showNow) {
  const several = data.escs.length > 1;
  const plots = [];
  const visible = data.escs.map(() => true);
  let range = [...whole];
  let cursorTime = null;
  const end = (event) => event.to ?? whole[1];
  const textOf = (event) => (several ? data.escs[event.esc] + ": " : "") + event.text;
  const toneOf = (event) => ink({ error: "--error", warning: "--warning" }[event.severity] ?? "--soft");

  // --- the time range and the cursor of all plots

  function setRange(from, to) {
    const span = Math.min(Math.max(to - from, MIN_SPAN), whole[1] - whole[0]);
    const begin = Math.min(Math.max((from + to - span) / 2, whole[0]), whole[1] - span);
    range = [begin, begin + span];
    for (const { u } of plots) u.setScale("x", { min: range[0], max: range[1] });
    showNow();
  }

  const zoom = (factor, about = (range[0] + range[1]) / 2) =>
    setRange(about - (about - range[0]) * factor, about + (range[1] - about) * factor);
  const pan = (share) => setRange(range[0] + share * (range[1] - range[0]), range[1] + share * (range[1] - range[0]));

  function setCursor(t) {
    for (const { u } of plots) {
      u.setCursor(t === null ? { left: -10, top: -10 } : { left: u.valToPos(t, "x"), top: u.over.clientHeight / 2 });
    }
  }

  // --- plots

  // Draws a line at the begin of each error, and a shade to its end.
  function drawMarks(u) {
    const { ctx, bbox } = u;
    const ratio = devicePixelRatio || 1;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    for (const event of data.errors) {
      if (!visible[event.esc] || end(event) < range[0] || event.from > range[1]) continue;
      const [x, xEnd] = [u.valToPos(event.from, "x", true), u.valToPos(end(event), "x", true)];
      ctx.fillStyle = toneOf(event);
      ctx.globalAlpha = 0.07;
      ctx.fillRect(x, bbox.top, xEnd - x, bbox.height);
      ctx.globalAlpha = 0.8;
      ctx.fillRect(x, bbox.top, ratio, bbox.height);
    }
    ctx.restore();
  }

  const STEPS = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600,
    7200, 14400, 28800, 86400];

  const digitsOf = (step) => Math.max(0, Math.ceil(-Math.log10(step * 1.001)));

  function timeLabels(u, splits) {
    const step = splits.length > 1 ? splits[1] - splits[0] : 1;
    return splits.map((t) => clock(t, digitsOf(step)));
  }

  // Returns the least distance of two time labels: the longest label and a gap.
  function timeSpace(u, index, from, to, width) {
    const step = ((to - from) * 70) / Math.max(width, 70);
    const longest = Math.max(clock(from, digitsOf(step)).length, clock(to, digitsOf(step)).length);
    return Math.max(60, longest * LETTER + 18);
  }

  function axis(more) {
    return {
      stroke: () => ink("--soft"),
      grid: { stroke: () => ink("--grid"), width: 1 },
      ticks: { stroke: () => ink("--grid"), width: 1, size: 5 },
      font: FONT,
      ...more,
    };
  }
  const timeAxis = (more) => axis({ incrs: STEPS, values: timeLabels, space: timeSpace, size: 28, ...more });

  function addPlot(figure, key, title, height, options, columns) {
    const box = make("div", { class: "plot", tabindex: "0", role: "group", "aria-label": `${title} over time` });
    figure.id = "plot-" + key;
    byId("plots").append(figure);
    figure.append(box);
    const plot = { key, box, height, showLines: () => plot.u.redraw(false) };
    plot.u = new uPlot({
      width: Math.max(200, box.clientWidth),
      height,
      padding: [8, RIGHT, 0, 0],
      legend: { show: false },
      ...options,
      scales: { x: { time: false, range: (u, from, to) => [from, to] }, ...options.scales },
      cursor: {
        y: false,
        drag: { x: true, y: false, dist: 4, setScale: false },
        points: { size: 7 },
        sync: { key: "time", setSeries: false, filters: { pub: (type) => type === "mousemove" || type === "mouseleave" } },
        bind: { dblclick: () => () => (setRange(...whole), null) },
      },
      hooks: {
        setSelect: [(u) => {
          const { left, width } = u.select;
          if (width > 0) setRange(u.posToVal(left, "x"), u.posToVal(left + width, "x"));
          u.setSelect({ left: 0, width: 0 }, false);
        }],
        setCursor: [(u) => {
          cursorTime = u.cursor.left >= 0 ? u.posToVal(u.cursor.left, "x") : null;
          showNow();
        }],
        draw: [drawMarks, options.draw ?? (() => {})],
      },
    }, [data.times, ...columns], box);
    plots.push(plot);
    listen(plot);
    return plot;
  }

  // --- lines over time

  // Returns the points with gaps on both sides, which no line shows.
  const isolated = (values) => [...values.keys()].filter((i) =>
    values[i] !== null && (values[i - 1] ?? null) === null && (values[i + 1] ?? null) === null);

  // Returns the value at the cursor. No value if the next point on the other side of the cursor has none.
  function valueAt(u, values, index, digits) {
    const t = u.posToVal(u.cursor.left, "x");
    const isOn = index === null || Math.abs(u.valToPos(data.times[index], "x") - u.cursor.left) <= 3;
    const next = isOn ? index : t < data.times[index] ? index - 1 : index + 1;
    return shown(index === null || (values[next] ?? null) === null ? null : values[index], digits);
  }

  function scaleRange(u, low, high) {
    if (!Number.isFinite(low)) return [0, 1];
    const pad = (high - low || Math.max(Math.abs(high), 1) * 0.1) * 0.08;
    return [low - pad < 0 && low >= 0 && low < high / 3 ? 0 : low - pad, high + pad];
  }

  function addLines(spec) {
    const styleOf = ({ esc, line }) => (several ? esc : line);
    const tone = (item) => ink(colour(styleOf(item)));
    const series = spec.series.map((item) => {
      const single = () => (item.drawn ? (item.single ??= isolated(item.values)) : []);
      return {
        // A line that is not drawn has its own scale, on which it would coincide with the drawn line.
        scale: item.drawn ? "y" : `y${item.line}`,
        ...(item.drawn ? {} : { paths: () => null }),
        label: [several ? data.escs[item.esc] : "", several && spec.lines.length === 1 ? "" : spec.lines[item.line]].join(" ").trim(),
        stroke: () => tone(item),
        width: several ? WIDTHS[item.line] : 1.6,
        dash: DASHES[dashes(styleOf(item))],
        points: { show: true, size: 4, fill: () => tone(item), filter: single },
        value: (u, value, at, index) => valueAt(u, item.values, index ?? null, spec.digits),
      };
    });
    const styleAt = (index) => styleOf(spec.series[index - 1]);
    const markers = {
      width: (u, index) => (several ? SAMPLE_WIDTHS[spec.series[index - 1].line] : 3),
      dash: (u, index) => dashes(styleAt(index)),
      stroke: (u, index) => (spec.series[index - 1].drawn ? `var(${colour(styleAt(index))})` : "transparent"),
    };
    const about = spec.unit + (spec.note ? ` (${spec.note})` : "");
    const caption = make("figcaption", {}, make("h3", {}, spec.title + " ", make("small", {}, about)));
    const scales = Object.fromEntries(["y", ...spec.lines.map((label, line) => `y${line}`)].map((key) => [key, { range: scaleRange }]));
    const plot = addPlot(make("figure", {}, caption), spec.key, spec.title, narrow ? 180 : 220, {
      scales,
      axes: [timeAxis(), axis({ size: AXIS, space: 32, values: (u, splits) => splits.map((v) => withSpaces(v.toLocaleString("en"))) })],
      series: [{}, ...series],
      legend: { markers, mount: (u, legend) => caption.append(legend) },
    }, spec.series.map((item) => item.values));
    plot.spec = spec;
    plot.showLines = () => spec.series.forEach((item, index) => plot.u.setSeries(index + 1, { show: visible[item.esc] }));
    return plot;
  }

  // Replaces the values of all lines of a plot that `addLines` has made.
  function setLines(plot, columns) {
    plot.spec.series.forEach((item, index) => Object.assign(item, { values: columns[index], single: null }));
    plot.u.setData([data.times, ...columns], false);
    plot.u.setScale("x", { min: range[0], max: range[1] });
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
    let held = null; // times below the two fingers when they touched
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
      const about = cursorTime ?? (range[0] + range[1]) / 2;
      const move = (share) => setCursor(Math.min(Math.max(about + share * (range[1] - range[0]), range[0]), range[1]));
      const actions = {
        ArrowLeft: () => (event.shiftKey ? pan(-0.1) : move(-0.01)),
        ArrowRight: () => (event.shiftKey ? pan(0.1) : move(0.01)),
        "+": () => zoom(0.6, about),
        "-": () => zoom(1 / 0.6, about),
        0: () => setRange(...whole),
        Escape: () => setCursor(null),
      };
      if (!actions[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      actions[event.key]();
    });
  }

  // --- light and dark, width

  function setTheme(isDark) {
    root.classList.toggle("dark", isDark);
    for (const { u } of plots) u.redraw(false, true);
  }

  function fit(width) {
    for (const { u, box, height } of plots) u.setSize({ width: width ?? Math.max(200, box.clientWidth), height });
  }

  return {
    data, plots, visible, several, end, textOf, toneOf, addPlot, addLines, setLines, axis, timeAxis, setRange, zoom, pan, setCursor,
    setTheme, fit, range: () => range, cursorTime: () => cursorTime,
  };
}

// Calls `setDark` for the theme of the system and after each press of the button #theme.
function startTheme(setDark) {
  const system = matchMedia("(prefers-color-scheme: dark)");
  setDark(system.matches);
  system.addEventListener("change", () => setDark(system.matches));
  byId("theme").addEventListener("click", () => setDark(!root.classList.contains("dark")));
}
