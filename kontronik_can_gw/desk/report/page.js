"use strict";
// The page of one flight: plots by uPlot with one common time range and cursor, a band of operating
// states and errors, and the list of events. Times are seconds of the recording. Text of the input
// becomes only text nodes, so it cannot inject HTML.
(async () => {
  const byId = (id) => document.getElementById(id);
  const packed = Uint8Array.from(atob(byId("data").textContent), (c) => c.charCodeAt(0));
  const data = await new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).json();
  const root = document.documentElement;
  const several = data.escs.length > 1;
  const narrow = innerWidth < 720;
  const whole = [data.from, Math.max(data.to, data.from + 0.1)];
  const MIN_SPAN = 0.05;
  const AXIS = narrow ? 48 : 58;
  const ROW = 15; // height of a row of text
  const LETTER = 6.6; // width of a digit in an axis label
  const RIGHT = 34; // room for half of the last time label
  const COLOURS = 8;
  const DASHES = { solid: [], dashed: [8, 4], dotted: [2, 3] }; // by the style of a border in CSS
  const FONT = "11px system-ui, sans-serif";
  const WIDTHS = [2, 1.2, 0.8]; // of a plot's lines, where colours and dashes tell ESCs apart
  const errors = data.events.filter((event) => event.kind === "error");
  const states = data.escs.map((name, esc) => data.events.filter((event) => event.kind === "state" && event.esc === esc));
  const plots = [];
  const visible = data.escs.map(() => true);
  let range = [...whole];
  let cursorTime = null;

  // --- small tools

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
  const end = (event) => event.to ?? whole[1];
  const textOf = (event) => (several ? data.escs[event.esc] + ": " : "") + event.text;
  const toneOf = (event) => ink({ error: "--error", warning: "--warning" }[event.severity] ?? "--soft");

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

  function goTo(from, to = from) {
    const pad = Math.max(2.5, (to - from) / 4);
    setRange(from - pad, to + pad);
    byId("plots").scrollIntoView({ block: "start" });
    setCursor(from);
  }

  const stateAt = (esc, t) => states[esc].findLast((state) => state.from <= t && t <= end(state));

  // Seconds of the long gaps before a time, which are cut out of the page.
  const cutBefore = (t) => data.cuts.reduce((sum, [begin, length]) => sum + (t > begin ? length : 0), 0);

  // Shows the time, states and errors at the cursor in the bar.
  function showNow() {
    const t = cursorTime;
    if (t === null) return byId("now").replaceChildren(`${clock(range[0])} to ${clock(range[1])}`);
    const parts = [clock(t, 2)];
    if (data.wall !== null) parts.push(new Date(data.wall + (t + cutBefore(t)) * 1000).toISOString().slice(11, 21) + " UTC");
    data.escs.forEach((name, esc) => {
      const state = visible[esc] && stateAt(esc, t);
      if (state) parts.push((several ? name + ": " : "") + state.text);
    });
    const reach = (range[1] - range[0]) / 400;
    for (const event of errors.filter((e) => visible[e.esc] && e.from - reach <= t && t <= end(e) + reach).slice(0, 5)) {
      parts.push(make("span", { class: event.severity }, textOf(event)));
    }
    byId("now").replaceChildren(...parts.flatMap((part, index) => (index ? [" · ", part] : [part])));
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
    for (const event of errors) {
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
      const single = item.drawn ? isolated(item.values) : [];
      return {
        // A line that is not drawn has its own scale, on which it would coincide with the drawn line.
        scale: item.drawn ? "y" : `y${item.line}`,
        ...(item.drawn ? {} : { paths: () => null }),
        label: [several ? data.escs[item.esc] : "", several && spec.lines.length === 1 ? "" : spec.lines[item.line]].join(" ").trim(),
        stroke: () => tone(item),
        width: several ? WIDTHS[item.line] : 1.6,
        dash: DASHES[dashes(styleOf(item))],
        points: { show: single.length > 0, size: 4, fill: () => tone(item), filter: () => single },
        value: (u, value, at, index) => valueAt(u, item.values, index ?? null, spec.digits),
      };
    });
    const styleAt = (index) => styleOf(spec.series[index - 1]);
    const markers = {
      width: 2,
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
    plot.showLines = () => spec.series.forEach((item, index) => plot.u.setSeries(index + 1, { show: visible[item.esc] }));
  }

  // --- the band: texts of errors, and below them a row of operating states for each ESC

  // Each text begins at its mark, in a row in which it covers no other text. Errors have priority over
  // warnings. Returns the number of texts for which there is no room.
  function drawErrorTexts(u, ratio, rows) {
    const { ctx, bbox } = u;
    const taken = Array.from({ length: rows }, () => []);
    const rank = (event) => ["error", "warning", "status"].indexOf(event.severity);
    const seen = errors.filter((event) => visible[event.esc] && end(event) >= range[0] && event.from <= range[1]);
    return seen.sort((a, b) => rank(a) - rank(b) || a.from - b.from).filter((event) => {
      const left = Math.max(u.valToPos(event.from, "x", true), bbox.left) + 3 * ratio;
      const right = left + ctx.measureText(textOf(event)).width + 6 * ratio;
      const row = taken.findIndex((spans) => right <= bbox.left + bbox.width && spans.every(([from, to]) => right <= from || left >= to));
      if (row < 0) return true;
      taken[row].push([left, right]);
      ctx.fillStyle = ink("--card"); // the marks of other errors end at a text
      ctx.fillRect(left - ratio, bbox.top + (row * ROW + 1) * ratio, right - left - 4 * ratio, (ROW - 2) * ratio);
      ctx.fillStyle = toneOf(event);
      ctx.fillText(textOf(event), left, bbox.top + (row + 0.5) * ROW * ratio);
      return false;
    }).length;
  }

  function drawStates(u, ratio, esc, top, height) {
    const { ctx, bbox } = u;
    ctx.globalAlpha = visible[esc] ? 1 : 0.2;
    for (const state of states[esc]) {
      if (end(state) < range[0] || state.from > range[1]) continue;
      const left = Math.max(u.valToPos(state.from, "x", true), bbox.left);
      const width = Math.min(u.valToPos(end(state), "x", true), bbox.left + bbox.width) - left;
      ctx.fillStyle = ink(`--s${state.phase}`);
      ctx.fillRect(left, top, Math.max(width - ratio, ratio), height);
      if (ctx.measureText(state.text).width > width - 8 * ratio) continue;
      ctx.fillStyle = ink("--ink");
      ctx.fillText(state.text, left + 4 * ratio, top + height / 2);
    }
  }

  function addBand() {
    const escs = [...data.escs.keys()].filter((esc) => states[esc].length);
    const textRows = Math.min(3, errors.length);
    if (!escs.length && !textRows) return;
    const note = make("small");
    const figure = make("figure", {}, make("h3", {}, "Operating state and errors ", note));
    const draw = (u) => {
      const { ctx, bbox } = u;
      const ratio = devicePixelRatio || 1;
      const top = bbox.top + textRows * ROW * ratio;
      const height = (bbox.top + bbox.height - top) / escs.length;
      ctx.save();
      ctx.font = `${11 * ratio}px system-ui, sans-serif`;
      ctx.textBaseline = "middle";
      ctx.textAlign = "left";
      const more = drawErrorTexts(u, ratio, textRows);
      note.textContent = more ? `${more} more: zoom in, or see the events` : "";
      escs.forEach((esc, row) => {
        let name = data.escs[esc];
        while (name.length > 1 && ctx.measureText(name).width > (AXIS - 8) * ratio) name = name.replace(/.…?$/u, "…");
        ctx.fillStyle = ink("--soft");
        ctx.textAlign = "right";
        ctx.fillText(name, bbox.left - 6 * ratio, top + (row + 0.5) * height);
        ctx.textAlign = "left";
        drawStates(u, ratio, esc, top + row * height + ratio, height - 2 * ratio);
        ctx.globalAlpha = 1;
      });
      ctx.restore();
    };
    const options = {
      scales: { y: { range: () => [0, 1] } },
      axes: [timeAxis({ grid: { show: false } }), axis({ size: AXIS, splits: () => [] })],
      series: [{}, { points: { show: false } }],
      draw,
    };
    addPlot(figure, "states", "Operating state", 38 + textRows * ROW + 26 * escs.length, options, [data.times.map(() => null)]);
    const met = [...new Set(states.flat().map((state) => state.phase))].sort((a, b) => a - b);
    figure.append(make("ul", { class: "states" }, ...met.map((phase) =>
      make("li", {}, make("i", { class: `s${phase}` }), data.phases[phase]))));
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

  // --- events

  const kindOf = (event) => (event.kind === "error" ? event.severity : event.kind);
  const MAX_EVENTS = 1000;

  function listEvents() {
    const needle = byId("search").value.trim().toLowerCase();
    const kind = byId("kind").value;
    const what = (e) => (e.kind === "state" ? data.phases[e.phase] + ": " : "") + e.text;
    const text = (e) => `${what(e)} ${kindOf(e)} ${data.escs[e.esc]} ${e.remedy} ${e.note}`.toLowerCase();
    const found = data.events.filter((e) => (!kind || e.kind === kind) && visible[e.esc] && text(e).includes(needle));
    const first = found.length > MAX_EVENTS ? `the first ${MAX_EVENTS} of ` : "";
    byId("count").textContent = `${first}${found.length} of ${data.events.length}`;
    byId("events").tBodies[0].replaceChildren(...found.slice(0, MAX_EVENTS).map((event) => {
      const length = event.to === event.from ? "" : `${(end(event) - event.from).toFixed(1)} s${event.to === null ? ", to the end" : ""}`;
      const row = make("tr", { class: event.severity },
        make("td", {}, make("button", { type: "button", class: "at" }, clock(event.from, 2))),
        ...[length, data.escs[event.esc], kindOf(event)].map((word) => make("td", {}, word)),
        make("td", { class: "what" }, what(event) + (event.note ? ` (${event.note})` : "")),
        make("td", { class: "do" }, event.remedy));
      row.addEventListener("click", () => goTo(event.from, end(event)));
      return row;
    }));
  }

  byId("search").addEventListener("input", listEvents);
  byId("kind").addEventListener("change", listEvents);

  // --- ESCs and buttons

  if (several) {
    data.escs.forEach((name, esc) => {
      const swatch = make("i", { class: `swatch c${esc % COLOURS} ${dashes(esc)}` });
      const button = make("button", { type: "button", "aria-pressed": "true" }, swatch, name);
      button.addEventListener("click", () => {
        visible[esc] = !visible[esc];
        button.setAttribute("aria-pressed", visible[esc]);
        for (const plot of plots) plot.showLines();
        listEvents();
      });
      byId("escs").append(button);
    });
  }
  const actions = { back: () => pan(-0.3), forth: () => pan(0.3), in: () => zoom(0.5), out: () => zoom(2), all: () => setRange(...whole) };
  for (const [id, action] of Object.entries(actions)) byId(id).addEventListener("click", action);
  for (const button of document.querySelectorAll("[data-at]")) {
    button.addEventListener("click", () => goTo(+button.dataset.at));
  }

  // --- light and dark, width, print

  function setTheme(isDark) {
    root.classList.toggle("dark", isDark);
    for (const { u } of plots) u.redraw(false, true);
  }

  function fit(width) {
    for (const { u, box, height } of plots) u.setSize({ width: width ?? Math.max(200, box.clientWidth), height });
  }

  const system = matchMedia("(prefers-color-scheme: dark)");
  setTheme(system.matches);
  system.addEventListener("change", () => setTheme(system.matches));
  byId("theme").addEventListener("click", () => setTheme(!root.classList.contains("dark")));
  addBand();
  data.plots.forEach(addLines);
  listEvents();
  setRange(...whole);
  new ResizeObserver(() => fit()).observe(byId("plots"));
  let wasDark = false;
  addEventListener("beforeprint", () => {
    wasDark = root.classList.contains("dark");
    setTheme(false);
    fit(680);
  });
  addEventListener("afterprint", () => {
    setTheme(wasDark);
    fit();
  });

  // Gives the console and the tests access to the data.
  globalThis.flight = { data, plots, setRange, setCursor, range: () => [...range] };
})();
