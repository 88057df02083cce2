"use strict";
// The page of one flight: plots (plots.js), a band of operating states and errors, and the list of
// events. Times are seconds of the recording. Text of the input becomes only text nodes, so it cannot
// inject HTML.
(async () => {
  const packed = Uint8Array.from(atob(byId("data").textContent), (c) => c.charCodeAt(0));
  const data = await new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).json();
  const whole = [data.from, Math.max(data.to, data.from + 0.1)];
  const ROW = 15; // height of a row of text
  const errors = data.events.filter((event) => event.kind === "error");
  data.errors = errors;
  const view = timePlots(data, whole, showNow);
  const { plots, visible, several, end, textOf, toneOf, axis, timeAxis, addPlot, addLines, setRange, zoom, pan, setCursor, setTheme, fit } = view;
  const states = data.escs.map((name, esc) => data.events.filter((event) => event.kind === "state" && event.esc === esc));

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
    const t = view.cursorTime();
    const range = view.range();
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

  // --- the band: texts of errors, and below them a row of operating states for each ESC

  // Each text begins at its mark, in a row in which it covers no other text. Errors have priority over
  // warnings. Returns the number of texts for which there is no room.
  function drawErrorTexts(u, ratio, rows) {
    const { ctx, bbox } = u;
    const range = view.range();
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
    const range = view.range();
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

  startTheme(setTheme);
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
  globalThis.flight = { data, plots, setRange, setCursor, range: () => [...view.range()] };
})();
