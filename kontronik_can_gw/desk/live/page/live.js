"use strict";
// The live page. The server sends a layout at the start, a step of the plots each second, and updates
// of all figures. Figures are shown as valid only while updates arrive: see `watch`.
(() => {
  const FROZEN_MS = 1000; // after this time without a message no figure is shown as valid
  const RETRY_MS = 5000;
  const DRIFT = 0.0005;
  const SPEAK_MS = 10000;
  const LONG = 7; // a figure with more characters is shown smaller
  const COMMAND = { headers: { "X-Kontronik-Page": "1" }, cache: "no-store" };
  const ICONS = { ok: "/static/icon.svg", error: "/static/icon-error.svg", offline: "/static/icon-offline.svg" };
  let layout = null;
  let layoutText = "";
  let source = null;
  let heard = performance.now(); // when the server sent the newest update
  let heardWall = Date.now(); // the same by a clock that goes on while a phone sleeps
  let offset = null; // difference of this device's time and the server's, in ms
  let tried = performance.now();
  let spoken = 0;
  let refused = "";
  let view = null; // the plots
  let cards = [];
  let steps = []; // the newest steps, oldest first
  let isPaused = false;
  let selected = null; // index of the ESC on the whole screen, null for all
  let told = "";
  const beyond = new Set(); // figures beyond a limit of this device

  // --- connection

  function connect() {
    source?.close();
    offset = null;
    tried = performance.now();
    source = new EventSource("/events");
    source.addEventListener("layout", (event) => receive(() => setLayout(event.data)));
    source.addEventListener("steps", (event) => receive(() => addSteps(JSON.parse(event.data))));
    source.addEventListener("update", (event) => receive(() => {
      const update = JSON.parse(event.data);
      show(update);
      setHeard(update.time * 1000);
    }));
    source.addEventListener("error", () => { if (source.readyState === EventSource.CLOSED) explain(); });
  }

  function receive(action) {
    refused = "";
    action();
    watch();
  }

  // On a slow connection updates are old when they arrive. The first one was sent after this page had
  // asked for it, which limits the difference of both clocks. DRIFT is how fast they may drift apart.
  function setHeard(sent) {
    const now = performance.now();
    offset = Math.min(now - sent, offset === null ? tried - sent : offset + (now - heard) * DRIFT);
    heard = sent + offset;
    heardWall = Date.now() - (now - heard);
  }

  // Asks why the server refuses the connection.
  async function explain() {
    try {
      const answer = await fetch("/events", { method: "HEAD", cache: "no-store" });
      refused = { 403: "this page needs its address with the token again", 503: "too many pages are open" }[answer.status] ?? "";
    } catch {
      refused = "";
    }
  }

  // A page that gets nothing must never look alive, also if the connection looks open.
  function watch() {
    const silent = Math.max(performance.now() - heard, Date.now() - heardWall);
    const isFrozen = silent > FROZEN_MS;
    document.body.classList.toggle("stale", isFrozen);
    byId("offline").hidden = !isFrozen;
    if (isFrozen) {
      const seconds = Math.floor(silent / 1000);
      const text = `no connection for ${seconds} s${refused ? `: ${refused}` : ""}`;
      if (byId("offline").textContent !== text) byId("offline").textContent = text;
      setTitle("offline", "no connection");
      if (performance.now() - tried > RETRY_MS) connect();
    }
  }

  function setTitle(kind, text) {
    const title = `${text ? `${text} – ` : ""}${layout?.name ?? "ESCs"}`;
    if (document.title !== title) document.title = title;
    if (byId("icon").getAttribute("href") !== ICONS[kind]) byId("icon").href = ICONS[kind];
  }

  // --- layout

  function setLayout(text) {
    steps = [];
    if (text === layoutText) return;
    if (layout && JSON.parse(text).version !== layout.version) return location.reload();
    layoutText = text;
    layout = JSON.parse(text);
    byId("name").textContent = layout.origin ? `${layout.name} (${layout.origin})` : layout.name;
    cards = layout.escs.map(makeCard);
    byId("escs").replaceChildren(...cards.map((card) => card.node));
    makePlots();
    makeLimits();
    const wanted = layout.escs.indexOf(decodeURIComponent(location.hash.slice(1)));
    select(wanted < 0 ? null : wanted);
  }

  const isMany = () => layout.escs.length > 1;

  function makeCard(name, esc) {
    const state = make("span", { class: "state" });
    const link = make("small", { class: "link" });
    const device = make("small", { class: "device" });
    const heading = make("h2", {}, name, state, link, device);
    if (isMany()) {
      const button = make("button", { type: "button" }, name);
      button.addEventListener("click", () => select(selected === null ? esc : null));
      heading.firstChild.replaceWith(make("i", { class: `swatch c${esc % COLOURS} ${dashes(esc)}` }), button);
    }
    const lists = { true: make("dl", { class: "figures" }), false: make("dl", { class: "figures" }) };
    const figures = layout.quantities.map((quantity) => {
      if (!quantity.has[esc]) return null;
      const number = make("span", {}, "–");
      const value = make("dd", { class: "value" }, number);
      const range = make("dd", { class: "range" });
      const node = make("div", { class: "figure" }, make("dt", {}, quantity.label, " ", make("span", { class: "unit" }, quantity.unit)), value, range);
      node.dataset.source = quantity.source;
      lists[quantity.isLarge].append(node);
      return { node, number, range };
    });
    const more = make("details", { class: "more" }, make("summary", {}, "More values"), lists.false);
    more.open = !narrow;
    return { node: make("article", { class: "esc", "aria-label": name }, heading, lists.true, more), state, link, device, figures };
  }

  // Shows one ESC on the whole screen, or all.
  function select(esc) {
    selected = isMany() ? esc : null;
    cards.forEach((card, index) => { card.node.hidden = selected !== null && index !== selected; });
    byId("escs").classList.toggle("several", isMany() && selected === null);
    byId("back").hidden = selected === null;
    history.replaceState(null, "", selected === null ? "/" : `#${encodeURIComponent(layout.escs[selected])}`);
    layout.escs.forEach((name, index) => { view.visible[index] = selected === null || index === selected; });
    for (const plot of view.plots) plot.showLines();
    if (selected !== null) scrollTo(0, 0);
  }

  // --- figures

  // Sets a text only if it has changed, so that the browser draws nothing else.
  function put(node, text) {
    if (node.textContent !== text) node.textContent = text;
  }

  function show(update) {
    put(byId("state"), [update.state[1], update.progress].filter(Boolean).join("  ·  "));
    byId("state").className = update.state[0];
    const notices = update.notices.map(([kind, text]) => `${kind} ${text}`).join("\n");
    if (notices !== told) {
      told = notices;
      byId("notices").replaceChildren(...update.notices.map(([kind, text]) => make("li", { class: kind }, text)));
    }
    update.escs.forEach((esc, index) => showEsc(cards[index], esc, index));
    showAlarms(update.alarms);
    speak(update);
    globalThis.live.updates += 1;
  }

  function showEsc(card, esc, index) {
    put(card.state, esc.state);
    put(card.link, `link ${esc.link}`);
    card.link.className = `link ${esc.isGood ? "good" : "bad"}`;
    put(card.device, esc.device);
    esc.values.forEach((given, at) => {
      const figure = card.figures[at];
      if (!figure) return;
      const { source: name, digits } = layout.quantities[at];
      const [value, age, low, high, mark] = given ?? [null, null, null, null, ""];
      const isOld = value === null || age !== null;
      const isBeyond = !isOld && isBeyondLimit(name, value);
      const text = shown(value, digits);
      put(figure.number, text);
      let range = low === null ? "" : `${shown(low, digits)} … ${shown(high, digits)}`;
      if (isOld) range = value === null ? "not available" : `${ageText(age)} old`;
      put(figure.range, range);
      const kinds = { old: isOld, beyond: isBeyond, long: text.length > LONG };
      figure.node.className = ["figure", mark, ...Object.keys(kinds).filter((kind) => kinds[kind])].join(" ");
      warn(`${index} ${name}`, isBeyond);
    });
  }

  const ageText = (seconds) => (seconds < 60 ? `${seconds.toFixed(1)} s` : clock(seconds, 0));

  function showAlarms(alarms) {
    const items = alarms.map((alarm) => {
      const length = ageText((alarm.to ?? 0) - alarm.from);
      const when = alarm.to === null ? `for ${length}` : `ended ${ageText(-alarm.to)} ago, lasted ${length}`;
      return { ...alarm, when: alarm.note ? `${when}; ${alarm.note}` : when, name: isMany() ? `${layout.escs[alarm.esc]}: ` : "" };
    });
    const list = byId("alarms");
    // only the times change in most updates
    const key = items.map((item) => [item.esc, item.text.replace(/ for .*?:/, ""), item.to === null, item.note].join()).join("\n");
    if (list.dataset.key !== key || !list.children.length) {
      list.dataset.key = key;
      list.replaceChildren(...items.map((item) =>
        make("li", { class: `${item.severity} ${item.to === null ? "present" : "ended"}` },
          make("b", {}), make("small", { class: "when" }), ...(item.remedy ? [make("small", {}, item.remedy)] : []))));
      if (!items.length) list.replaceChildren(make("li", {}, "none since the page's server was started"));
    }
    items.forEach((item, index) => {
      put(list.children[index].children[0], item.name + item.text);
      put(list.children[index].children[1], item.when);
    });
    const present = items.filter((item) => item.to === null);
    const worst = present.find((item) => item.severity === "error") ?? present[0];
    byId("worst").hidden = !worst;
    byId("worst").className = worst?.severity ?? "";
    if (worst) put(byId("worst"), `${worst.name}${worst.text}${present.length > 1 ? ` (and ${present.length - 1} more)` : ""}`);
    setTitle(worst || beyond.size ? "error" : "ok", worst ? `⚠ ${worst.text}` : beyond.size ? "⚠ limit" : "");
    view.data.errors = alarms.filter((alarm) => alarm.severity !== "status");
  }

  // Tells a screen reader the state, but not each change of a figure.
  function speak(update) {
    if (performance.now() - spoken < SPEAK_MS) return;
    spoken = performance.now();
    const words = update.escs.map((esc, index) => {
      if (selected !== null && selected !== index) return "";
      const figures = layout.quantities.slice(0, 3).map((quantity, at) => {
        const given = esc.values[at];
        const value = given && given[1] === null ? `${shown(given[0], quantity.digits)} ${quantity.unit}` : "not available";
        return `${quantity.label} ${value}`;
      });
      return `${layout.escs[index]} ${esc.state}: ${figures.join(", ")}.`;
    });
    put(byId("spoken"), words.filter(Boolean).join(" "));
  }

  // --- limits of this device

  const limits = (() => {
    try {
      return JSON.parse(localStorage.getItem("limits") ?? "{}");
    } catch {
      return {};
    }
  })();
  let sound = null;

  const quantityOf = (name) => layout.quantities.find((quantity) => quantity.source === name);

  function isBeyondLimit(name, value) {
    const limit = limits[name];
    if (typeof limit !== "number") return false;
    return quantityOf(name).isUpper ? value > limit : value < limit;
  }

  function makeLimits() {
    const known = layout.quantities.filter((quantity) => /voltage|current|temperature/.test(quantity.source));
    byId("limit-list").replaceChildren(...known.map((quantity) => {
      const input = make("input", { type: "number", step: "any", inputmode: "decimal" });
      input.value = limits[quantity.source] ?? "";
      input.addEventListener("change", () => {
        if (input.value === "") delete limits[quantity.source];
        else limits[quantity.source] = Number(input.value);
        localStorage.setItem("limits", JSON.stringify(limits));
        sound ??= new AudioContext(); // browsers allow sound after an input only
      });
      return make("label", {}, `${quantity.label} ${quantity.isUpper ? "above" : "below"} (${quantity.unit})`, input);
    }));
  }

  function warn(key, isBeyond) {
    if (!isBeyond) return beyond.delete(key);
    if (beyond.has(key)) return;
    beyond.add(key);
    beep();
  }

  function beep() {
    sound ??= new AudioContext();
    sound.resume();
    const tone = sound.createOscillator();
    const volume = sound.createGain();
    tone.frequency.value = 880;
    volume.gain.value = 0.3;
    tone.connect(volume).connect(sound.destination);
    tone.start();
    tone.stop(sound.currentTime + 0.4);
    globalThis.live.beeps += 1;
  }

  // --- plots

  // Each step has two points of each line: its extremes in their order.
  function makePlots() {
    const { stepCount } = layout;
    const times = Array.from({ length: 2 * stepCount }, (_, index) => (index + 1) / 2 - stepCount);
    byId("plots").replaceChildren();
    view = timePlots({ escs: layout.escs, times, errors: [] }, [-stepCount, 0], showNow);
    layout.plots.forEach((plot) => {
      for (const item of plot.series) Object.assign(item, { drawn: true, values: times.map(() => null) });
      view.addLines(plot);
    });
    view.setTheme(root.classList.contains("dark"));
    view.setRange(-stepCount, 0);
    view.fit();
  }

  function addSteps(added) {
    steps = steps.concat(added).slice(-layout.stepCount);
    if (!isPaused) draw();
  }

  function draw() {
    const missing = layout.stepCount - steps.length;
    let line = 0;
    for (const plot of view.plots) {
      const columns = plot.spec.series.map(() => {
        const values = new Array(2 * missing).fill(null);
        for (const step of steps) values.push(step[2 * line], step[2 * line + 1]);
        line += 1;
        return values;
      });
      view.setLines(plot, columns);
    }
  }

  function showNow() {
    const time = view?.cursorTime() ?? null;
    const [from, to] = view?.range() ?? [0, 0];
    put(byId("now"), `${isPaused ? "paused, " : ""}${time === null ? `${clock(from, 0)} to ${clock(to, 0)}` : clock(time)}`);
  }

  function pause() {
    isPaused = !isPaused;
    byId("pause").setAttribute("aria-pressed", isPaused);
    if (!isPaused) draw();
    showNow();
  }

  // --- buttons

  const actions = {
    pause,
    in: () => view.zoom(0.5, view.range()[1]),
    out: () => view.zoom(2, view.range()[1]),
    earlier: () => view.pan(-0.3),
    later: () => view.pan(0.3),
    whole: () => view.setRange(-layout.stepCount, 0),
    back: () => select(null),
    worst: () => byId("alarms-title").scrollIntoView(),
    reset: () => fetch("/reset", COMMAND).catch(() => {}),
  };
  for (const [id, action] of Object.entries(actions)) byId(id).addEventListener("click", () => (layout || id === "reset") && action());
  startTheme((isDark) => (view ? view.setTheme(isDark) : root.classList.toggle("dark", isDark)));
  new ResizeObserver(() => view?.fit()).observe(byId("plots"));
  document.addEventListener("visibilitychange", () => {
    if (document.hidden) return;
    watch();
    if (document.body.classList.contains("stale")) connect();
  });
  addEventListener("pageshow", (event) => { if (event.persisted) connect(); });
  // Gives the tests access.
  globalThis.live = { beeps: 0, updates: 0, view: () => view, steps: () => steps, heard: () => heard, layout: () => layout };
  setInterval(watch, 200);
  connect();
})();
