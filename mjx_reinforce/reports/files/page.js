// Draws the charts, and lets the check boxes and the slider change what they show.
(() => {
  "use strict";
  const content = JSON.parse(document.getElementById("content").textContent);
  const {labels, specs, tables, moments, results} = content;
  const views = {};
  // Vega's number for errors alone: it warns where a chart has nothing to show, which is no mistake.
  const ERRORS = 1;
  const each = (selector, act) => document.querySelectorAll(selector).forEach(act);
  const boxes = [...document.querySelectorAll("input[name=configuration]")];
  const slider = document.getElementById("moment");
  const toggles = {x: document.getElementById("log-x"), y: document.getElementById("log-y")};

  const rows = (name) => {
    const names = Object.keys(tables[name]);
    return tables[name][names[0]].map((_, i) =>
      Object.fromEntries(names.map((key) => {
        const value = tables[name][key][i];
        return [key, key === "configuration" ? labels[value] : value];
      })));
  };
  const shown = () => boxes.length
    ? boxes.filter((box) => box.checked).map((box) => labels[Number(box.value)])
    : labels;

  // Every data set that a chart names.
  const datasets = (spec) => {
    const names = new Set();
    JSON.stringify(spec, (key, value) => {
      if (key === "data" && value && value.name in tables) names.add(value.name);
      return value;
    });
    return [...names];
  };
  const numbersOf = (name, key) => tables[name][key].filter(Number.isFinite);
  const numbers = (name) => rows(name).flatMap((row) => [row.value, row.low, row.high])
    .filter(Number.isFinite);

  // Vega-Lite settles the kind of a scale when it compiles a chart: so it is drawn again.
  const withAxes = (spec) => {
    const copy = structuredClone(spec);
    const change = (part) => {
      if (Array.isArray(part)) return part.forEach(change);
      if (!part || typeof part !== "object") return;
      const {x, y} = part.encoding ?? {};
      if (x?.field === "env_steps" && toggles.x.checked) {
        x.scale = {...x.scale, type: "log"};
        const steps = numbersOf("curves", "env_steps").filter((step) => step > 0);
        const decades = Math.log10(Math.max(...steps) / Math.min(...steps));
        const leading = decades > 1.5 ? [1, 3] : [1, 2, 5];
        const powers = [1, 10, 100, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8];
        x.axis = {...x.axis, values: powers.flatMap((p) => leading.map((d) => d * p))};
      }
      if (y?.field && y.field !== "share" && toggles.y.checked) {
        const all = numbers("curves");
        const [low, high] = [Math.min(...all), Math.max(...all)];
        const powers = [1, 10, 100, 1e3, 1e4, 1e5, 1e6];
        const ticks = [...powers.map((p) => -p), 0, ...powers];
        y.scale = {...y.scale, type: "symlog"};
        y.axis = {...y.axis, values: ticks.filter((t) => t >= low && t <= high)};
      }
      Object.values(part).forEach(change);
    };
    change(copy);
    copy.params = (copy.params ?? []).map((param) =>
      param.name === "logarithmic" ? {...param, value: toggles.x.checked} : param);
    return copy;
  };

  const set = (view, signals) => {
    for (const [name, value] of Object.entries(signals)) {
      try { view.signal(name, value); } catch { /* this chart has no such parameter */ }
    }
    return view.runAsync();
  };
  const state = () => {
    const moment = Number(slider.value);
    return {shown: shown(), moment, at: moments[moment]};
  };
  const apply = (name) => {
    const signals = state();
    if (name === "distribution") signals.height = Math.max(1, signals.shown.length) * content.row;
    return views[name] ? set(views[name], signals) : Promise.resolve();
  };
  const applyAll = () => Promise.all(Object.keys(views).map(apply));

  const draw = async (name) => {
    const spec = withAxes(specs[name]);
    spec.datasets = Object.fromEntries(datasets(spec).map((data) => [data, rows(data)]));
    const target = document.getElementById(`chart-${name}`);
    const options = {actions: false, renderer: "svg", logLevel: ERRORS};
    views[name]?.finalize();
    views[name] = (await vegaEmbed(target, spec, options)).view;
    await apply(name);
  };

  const save = (name, text, kind) => {
    const link = document.createElement("a");
    link.download = name;
    link.href = URL.createObjectURL(new Blob([text], {type: kind}));
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  };
  const quoted = (value) => {
    const text = value === null ? "" : String(value);
    return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  };
  const csv = (listed) => listed.length
    ? [Object.keys(listed[0]), ...listed.map(Object.values)].map((row) => row.map(quoted).join(","))
      .join("\n") + "\n"
    : "";
  const savePicture = async (name, kind) => {
    const light = content.light;
    const text = JSON.stringify(specs[name]).replace(/var\(--([\w-]+)\)/g, (_, key) => light[key]);
    const spec = {...JSON.parse(text), width: 720, background: light.paper};
    spec.datasets = Object.fromEntries(datasets(spec).map((data) => [data, rows(data)]));
    const holder = document.createElement("div");
    const made = await vegaEmbed(holder, spec, {actions: false, renderer: "none", logLevel: ERRORS});
    await set(made.view, name === "distribution"
      ? {...state(), height: Math.max(1, shown().length) * content.row} : state());
    const link = document.createElement("a");
    link.download = `${name}.${kind}`;
    link.href = await made.view.toImageURL(kind, 2);
    link.click();
    made.finalize();
  };

  const fill = (place) => {
    const table = document.createElement("table");
    const listed = rows(place.dataset.table).filter((row) => shown().includes(row.configuration));
    if (!listed.length) return;
    const line = (parent, cells, kind) => {
      const row = parent.insertRow();
      for (const text of cells) {
        const cell = document.createElement(kind);
        cell.textContent = text ?? "";
        row.append(cell);
      }
    };
    line(table.createTHead(), Object.keys(listed[0]).map((key) => key.replaceAll("_", " ")), "th");
    const body = table.createTBody();
    for (const row of listed) line(body, Object.values(row), "td");
    place.replaceChildren(table);
  };

  each("details.data", (details) => details.addEventListener("toggle", () => {
    if (details.open) fill(details.querySelector(".numbers"));
  }));
  each("[data-csv]", (button) => button.addEventListener("click", () =>
    save(`${button.dataset.csv}.csv`, csv(rows(button.dataset.csv)), "text/csv")));
  each("[data-png]", (button) => button.addEventListener("click", () =>
    savePicture(button.dataset.png, "png")));
  each("[data-svg]", (button) => button.addEventListener("click", () =>
    savePicture(button.dataset.svg, "svg")));
  document.getElementById("results-csv").addEventListener("click", () =>
    save("results.csv", results, "text/csv"));
  const refill = () => each("details.data[open] .numbers", fill);
  boxes.forEach((box) => box.addEventListener("change", () => { applyAll(); refill(); }));
  each("[data-choose]", (button) => button.addEventListener("click", () => {
    const number = Number(button.dataset.choose);
    boxes.forEach((box) => { box.checked = Number(box.value) < number; });
    applyAll();
    refill();
  }));
  Object.values(toggles).forEach((toggle) => toggle.addEventListener("change", async () => {
    for (const name of ["curves", "solved"]) if (name in specs) await draw(name);
  }));
  // On paper, charts are as wide as PRINTED pixels here, whatever the window: it is not resized.
  const PRINTED = 780;
  const ROWS = ["final", "distribution"];  // with words between them
  const redraw = (whole, height) => {
    const page = document.querySelector("figure").clientWidth;
    for (const [name, view] of Object.entries(views)) {
      if (!ROWS.includes(name)) view.height(specs[name].height * height);
      view.width(view.container().clientWidth * whole / page).run();
    }
  };
  addEventListener("beforeprint", () => redraw(PRINTED, 0.8));
  addEventListener("afterprint", () => redraw(document.querySelector("figure").clientWidth, 1));
  const output = document.getElementById("moment-said");
  const tell = () => {
    const moment = Number(slider.value);
    const text = moment === moments.length - 1
      ? "the end: the last evaluation of each seed, as in table 1"
      : `${moments[moment].toLocaleString("en")} env steps per seed`;
    output.textContent = text;
    slider.setAttribute("aria-valuetext", text);
  };
  slider.addEventListener("input", () => { tell(); applyAll(); });
  tell();
  (async () => {
    for (const name of Object.keys(specs)) await draw(name);
    document.documentElement.dataset.ready = "yes";
  })();
})();
