"use strict";
// The list of flights, newest first. Reports and tables are made by the server when they are asked for.
(() => {
  const POLL_MS = 2000;
  const COMMAND = { headers: { "X-Kontronik-Page": "1" }, cache: "no-store" };
  const NAMES = { report: "Report", csv: "CSV", parquet: "Parquet" };
  const BUSY_TEXT = { report: "Making the report", csv: "Making the CSV file", parquet: "Making the Parquet file" };
  const wanted = new Map(); // the kind that this page has asked for, by flight
  const drawn = new Map(); // the text of each flight that is shown
  let timer = 0;

  async function load() {
    clearTimeout(timer);
    let text = "";
    let isPending = false;
    try {
      const answer = await fetch("/flights.json", { cache: "no-store" });
      if (!answer.ok) throw new Error(await answer.text());
      const list = await answer.json();
      text = list.problem || (list.flights.length ? "" : "There are no captures in the folder yet.");
      isPending = list.flights.some(isBusy) || list.flights.some((flight) => flight.isWritten || !flight.summary);
      show(list);
    } catch (error) {
      text = error instanceof TypeError ? "No connection to the server. Trying again." : String(error.message);
      isPending = true;
    }
    byId("problem").textContent = text;
    byId("problem").hidden = !text;
    if (isPending && !document.hidden) timer = setTimeout(load, POLL_MS);
  }

  const stateIsBusy = (state) => state === "waiting" || typeof state === "number";
  const isBusy = (flight) => Object.values(flight.states).some(stateIsBusy);
  const fileOf = (flight, kind) => `/flights/${flight.id}/${kind}`;

  function show(list) {
    const old = new Map([...byId("flights").children].map((node) => [node.id, node]));
    const nodes = list.flights.map((flight) => {
      const key = JSON.stringify([flight, list.kinds]);
      const id = `flight-${flight.id}`;
      if (drawn.get(id) === key && old.has(id)) return old.get(id);
      drawn.set(id, key);
      const node = make("li", { class: "flight", id }, ...describe(flight, list.kinds));
      const focused = old.get(id)?.contains(document.activeElement) ? document.activeElement.dataset.kind : null;
      if (focused) queueMicrotask(() => node.querySelector(`[data-kind=${focused}]`)?.focus());
      return node;
    });
    byId("flights").replaceChildren(...nodes);
    for (const flight of list.flights) {
      const kind = wanted.get(flight.id);
      if (!kind || stateIsBusy(flight.states[kind])) continue;
      wanted.delete(flight.id);
      if (flight.states[kind] === "made") location.href = fileOf(flight, kind);
    }
  }

  function describe(flight, kinds) {
    const { summary } = flight;
    const start = summary?.start ? new Date(summary.start).toLocaleString() : summary ? "Clock not set" : flight.name;
    const facts = { Capture: `${flight.name}, ${shown(flight.size / 1e6, 1)} MB` };
    if (summary) {
      Object.assign(facts, {
        Duration: clock(summary.duration, 0),
        "Peak current": summary.current === null ? "–" : `${shown(summary.current, 1)} A`,
        "Lowest voltage": summary.voltage === null ? "–" : `${shown(summary.voltage, 2)} V`,
        Energy: summary.energy === null ? "–" : `${shown(summary.energy, 1)} Wh`,
        Errors: `${summary.errors}${summary.warnings ? `, warnings: ${summary.warnings}` : ""}`,
      });
    }
    const parts = [
      make("h2", { class: summary?.errors ? "error" : "" }, start),
      make("dl", {}, ...Object.entries(facts).map(([name, text]) => make("div", {}, make("dt", {}, name), make("dd", {}, text)))),
    ];
    if (flight.isWritten) parts.push(make("p", { class: "note" }, "It is being recorded."));
    if (summary?.damage) parts.push(make("p", { class: "warning" }, "The capture is damaged. Its intact parts are shown."));
    for (const [kind, state] of Object.entries(flight.states)) {
      if (state?.failed) parts.push(make("p", { class: "warning" }, `${NAMES[kind] ?? "Summary"}: ${state.failed}`));
      else if (stateIsBusy(state)) parts.push(...busy(kind, state));
    }
    const buttons = kinds.map((kind) => {
      const button = make("button", { type: "button", "data-kind": kind }, NAMES[kind]);
      button.addEventListener("click", () => ask(flight, kind));
      return button;
    });
    for (let part = 0; part < flight.parts; part += 1) {
      const name = flight.parts > 1 ? `Capture ${part + 1}` : "Capture";
      buttons.push(make("a", { class: "button", href: fileOf(flight, `capture/${part}`), download: "" }, name));
    }
    return [...parts, make("div", { class: "buttons" }, ...buttons)];
  }

  function busy(kind, state) {
    const text = BUSY_TEXT[kind] ?? "Reading the numbers";
    if (state === "waiting") return [make("p", { class: "note" }, `${text}: waiting for others`)];
    return [make("p", { class: "note" }, text), make("progress", { value: state, max: 1, "aria-label": text })];
  }

  // Opens a file if it is made. Otherwise the server makes it, and it is opened when it is ready.
  async function ask(flight, kind) {
    if (flight.states[kind] === "made") {
      location.href = fileOf(flight, kind);
      return;
    }
    wanted.set(flight.id, kind);
    await fetch(`/make/${flight.id}/${kind}`, COMMAND).catch(() => {});
    load();
  }

  startTheme((isDark) => root.classList.toggle("dark", isDark));
  document.addEventListener("visibilitychange", () => document.hidden || load());
  addEventListener("pageshow", load);
  globalThis.flights = { load };
})();
