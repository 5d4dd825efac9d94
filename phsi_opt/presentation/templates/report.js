"use strict";
(async function () {
  const root = document.documentElement;
  const data = JSON.parse(document.getElementById("data").textContent);
  const drawn = [];

  // Colours: as the system has them, or one of two; kept while the page is open.
  const themes = ["", "light", "dark"];
  const names = ["Colours: as the system", "Colours: light", "Colours: dark"];
  let theme = 0;
  document.getElementById("theme").addEventListener("click", function () {
    theme = (theme + 1) % themes.length;
    if (themes[theme]) root.dataset.theme = themes[theme];
    else delete root.dataset.theme;
    this.textContent = names[theme];
    drawAll();
  });

  // On a phone the answers come first; what stands behind them is opened.
  if (matchMedia("(max-width: 40rem)").matches) {
    document.querySelectorAll(".facts > div:not(:last-child) details").forEach((one) => { one.open = false; });
  }

  // On paper nothing can be opened: everything is.
  window.addEventListener("beforeprint", function () {
    document.querySelectorAll("details").forEach((one) => { one.open = true; });
  });

  try {
    const packed = atob(document.getElementById("library").textContent);
    const bytes = Uint8Array.from(packed, (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const code = await new Response(stream).text();
    const script = document.createElement("script");
    script.textContent = code;
    document.head.appendChild(script);
    if (!window.Plotly) throw new Error("no chart library");
  } catch (error) {
    return; // the static pictures stay
  }
  root.classList.add("charts");

  // The library reads a few tags in texts; names of the data are plain text.
  function plain(text) {
    return String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
  }
  function color(name) {
    return getComputedStyle(root).getPropertyValue("--" + name).trim();
  }
  function faint(name, share) {
    const hex = color(name).slice(1);
    const parts = [0, 2, 4].map((k) => parseInt(hex.slice(k, k + 2), 16));
    return `rgba(${parts.join(",")},${share})`;
  }
  function withUnit(name, unit) {
    return plain(unit ? `${name} (${unit})` : name);
  }
  function since(label, date) {
    return date ? `${label} since ${plain(date)}` : label;
  }
  function shortened(text, most) {
    return text.length > most ? text.slice(0, most - 1) + "\u2026" : text;
  }
  // As in the text: 2.79×10⁻⁶, where a decimal would have many zeros.
  function powerOfTen(value) {
    const [digits, power] = value.toExponential(2).split("e");
    const raised = power.replace("+", "").replace(/[-\d]/g, (sign) => (sign === "-" ? "\u207b" : "\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079"[sign]));
    return `${Number(digits)}\u00d710${raised}`;
  }
  function wrapped(text, width) {
    const lines = [""];
    for (const word of text.split(" ")) {
      const last = lines[lines.length - 1];
      if (last && last.length + word.length >= width) lines.push(word);
      else lines[lines.length - 1] = last ? `${last} ${word}` : word;
    }
    return lines.map((line) => plain(shortened(line, 2 * width))).join("<br>");
  }
  function layout(extra) {
    const axis = { gridcolor: faint("line", 0.5), linecolor: color("line"), zerolinecolor: color("quiet"), automargin: true, exponentformat: "power" };
    const result = {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: color("text"), size: 13, family: "system-ui, sans-serif" },
      margin: { l: 60, r: 16, t: 12, b: 44 }, hovermode: "x unified",
      hoverlabel: { bgcolor: color("card"), font: { color: color("text") } },
      legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 }, showlegend: true,
    };
    for (const key of Object.keys(extra)) {
      if (!key.match(/axis/)) result[key] = extra[key];
      else result[key] = Object.assign({}, axis, key === "xaxis" ? { zeroline: false } : {}, extra[key]);
    }
    return result;
  }
  const settings = { responsive: true, displaylogo: false, displayModeBar: false };

  function draw(id, traces, extra) {
    const place = document.getElementById(id);
    if (place) Plotly.react(place, traces, layout(extra), settings);
  }

  function styleOf(number, count) {
    if (number === count - 1) return { color: color("after"), dash: "solid", width: 2 };
    if (number === 0) return { color: color("before"), dash: "dash", width: 2 };
    return { color: color("between"), dash: "dot", width: 2 };
  }

  function staircase() {
    const content = data.staircase;
    const steps = content.steps;
    const narrow = window.innerWidth < 600;
    const x = steps.map((_, k) => k);
    const width = Math.max(10, Math.floor((narrow ? 44 : 72) / Math.max(steps.length, 1)));
    const labels = steps.map((step, k) => wrapped((k && !step.label.startsWith("without ") ? "+ " : "") + step.label, width));
    const held = steps.some((step) => step.held_out !== null);
    // Side by side, each with its numbers on its own side: equal errors do not hide each other.
    const aside = held ? 0.05 : 0;
    const shown = (value) => (value === null ? "" : Math.abs(value) < 1e-4 ? powerOfTen(value) : Number(value.toPrecision(3)).toString());
    // A number stands where no line comes from: below a training error that fell, above a floor that lies low.
    const fell = steps.map((step, k) => k > 0 && step.train < steps[k - 1].train && step.train > 0.2 * Math.max(...steps.map((one) => one.train)));
    const last = steps[steps.length - 1];
    const isLow = (held ? last.held_out : last.train) > 2 * last.floor;
    const curve = (key, name, line, symbol, shift, place) => ({
      x: x.map((one) => one + shift), y: steps.map((step) => step[key]), name: name, line: line, mode: "lines+markers+text",
      marker: { size: symbol === "line-ew-open" ? 20 : 9, symbol: symbol }, textposition: place, cliponaxis: false,
      text: steps.map((step, k) => (key !== "floor" ? shown(step[key]) : k === steps.length - 1 ? "floor " + shown(step[key]) : "")),
      textfont: { color: line.color, size: 13 }, hovertemplate: "%{y:.4g}",
    });
    const traces = [curve("train", "training", { color: color("measured"), dash: "dash" }, "square", -aside, held ? fell.map((one) => (one ? "bottom left" : "top left")) : "top right")];
    if (held) traces.push(curve("held_out", "held out", { color: color("after") }, "circle", aside, "top right"));
    traces.push(curve("floor", "noise floor", { color: color("floor"), dash: "dot" }, "line-ew-open", 0, isLow ? "top right" : "bottom right"));
    const errors = steps.flatMap((step) => [step.train, step.held_out, step.floor]).filter((v) => v !== null && v > 0);
    const most = Math.max(...errors), least = Math.min(...errors);
    const log = most >= 10 * least && steps.length > 1;
    const ticks = log ? { dtick: most >= 100 * least ? 1 : "D2", minorloglabels: "complete", tickformat: least > 1e-4 ? "~g" : "" } : {};
    // Room for the number of the floor, behind the last step.
    const share = 95 / Math.max(document.getElementById("staircase").clientWidth - 76, 200);
    const behind = Math.max(0.45, (share * (steps.length - 0.4)) / (1 - share));
    const unit = content.unit;
    draw("staircase", traces, {
      xaxis: { tickvals: x, ticktext: labels, range: [-0.6, steps.length - 1 + behind], zeroline: false },
      yaxis: Object.assign(ticks, { type: log ? "log" : "linear", range: log ? [Math.log10(least / 2), Math.log10(2 * most)] : [0, 1.2 * most], title: { text: unit.startsWith("%") ? "error<br>(%)" : withUnit("error", unit) } }),
    });
  }

  function measured() {
    const content = data.runs;
    const run = content.runs[Number(document.getElementById("run").value)];
    const k = Number(document.getElementById("channel").value || 0);
    const one = run.channels[k];
    const info = content.channels[k];
    if (!one) return;
    const traces = [{ x: one.t, y: one.measured, name: "measured", mode: "markers", marker: { color: color("measured"), size: 4 }, hovertemplate: "%{y:.4g}" }];
    one.models.forEach((values, m) => {
      const line = styleOf(m, one.models.length);
      const visible = m > 0 && m < one.models.length - 1 ? "legendonly" : true;
      const group = "model " + m;
      traces.push({ x: one.t, y: values, name: plain(shortened(content.models[m], 44)), line: line, mode: "lines", legendgroup: group, visible: visible, hovertemplate: "%{y:.4g}" });
      traces.push({ x: one.t, y: one.residuals[m], yaxis: "y2", name: "residual, " + plain(shortened(content.models[m], 44)), line: line, mode: "lines", legendgroup: group, showlegend: false, visible: visible, hovertemplate: "%{y:.3g}" });
    });
    const shapes = [];
    const notes = [];
    if (info.noise !== null) {
      shapes.push({ type: "rect", xref: "paper", x0: 0, x1: 1, yref: "y2", y0: -2 * info.noise, y1: 2 * info.noise, fillcolor: faint("floor", 0.2), line: { width: 0 }, layer: "below" });
      notes.push({ xref: "paper", x: 1, xanchor: "right", yref: "paper", y: 0.33, yanchor: "bottom", showarrow: false, text: "residual; band: noise, 2 std. deviations", font: { size: 12, color: color("floor") } });
    }
    draw("measured", traces, {
      xaxis: { anchor: "y2", title: { text: since(withUnit("t", content.unit_of_time), run.since) } },
      yaxis: { domain: [0.42, 1], title: { text: withUnit(info.name, info.unit) } },
      yaxis2: { domain: [0, 0.32], title: { text: withUnit("residual", info.unit) } },
      shapes: shapes, annotations: notes, uirevision: run.name + " " + k,
    });
  }

  function band(x, middle, half, name) {
    const upper = middle.map((v, k) => (v === null || half[k] === null ? null : v + half[k]));
    const lower = middle.map((v, k) => (v === null || half[k] === null ? null : v - half[k]));
    return [
      { x: x, y: upper, mode: "lines", line: { width: 0 }, showlegend: false, hoverinfo: "skip" },
      { x: x, y: lower, mode: "lines", line: { width: 0 }, fill: "tonexty", fillcolor: faint("after", 0.22), name: name, hoverinfo: "skip" },
    ];
  }

  // Beside the verdict: one channel, the force that is missing there below it.
  function glance() {
    const place = data.glance;
    if (!place) return;
    const run = data.runs.runs[place.run];
    const one = run.channels[place.channel];
    const info = data.runs.channels[place.channel];
    const traces = [{ x: one.t, y: one.measured, name: "measured", mode: "markers", marker: { color: color("measured"), size: 4 }, hovertemplate: "%{y:.4g}" }];
    one.models.forEach((values, m) => {
      if (m === 0 || m === one.models.length - 1) traces.push({ x: one.t, y: values, name: m ? "present model" : "base model", line: styleOf(m, one.models.length), mode: "lines", hovertemplate: "%{y:.4g}" });
    });
    const lacks = place.force;
    const below = lacks ? band(lacks.t, lacks.force, lacks.std.map((v) => (v === null ? null : 2 * v)), "\u00b1 2 std.") : [];
    if (lacks) below.push({ x: lacks.t, y: lacks.force, mode: "lines", line: { color: color("between"), width: 2 }, name: "missing", hovertemplate: "%{y:.3g}" });
    below.forEach((trace) => { trace.yaxis = "y2"; });
    const shapes = [];
    if (place.window) shapes.push({ type: "rect", xref: "x", x0: place.window[0], x1: place.window[1], yref: "paper", y0: 0, y1: 1, fillcolor: faint("before", 0.18), line: { width: 1, color: faint("before", 0.7) }, layer: "below" });
    draw("glance", traces.concat(below), {
      xaxis: { anchor: lacks ? "y2" : "y", title: { text: since(withUnit("t", data.runs.unit_of_time), run.since) } },
      yaxis: { domain: [lacks ? 0.55 : 0, 1], title: { text: withUnit(info.name, info.unit) } },
      yaxis2: { domain: [0, 0.42], title: { text: wrapped(place.label, 14) } },
      shapes: shapes, legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0, traceorder: "normal" },
    });
  }

  function follows(id, one, label) {
    const parts = band(one.centre, one.mean, one.std, "spread");
    parts.unshift({ x: one.x, y: one.force, mode: "markers", marker: { color: color("measured"), size: 3, opacity: 0.6 }, name: "force", hoverinfo: "skip" });
    parts.push({ x: one.centre, y: one.mean, mode: "lines+markers", line: { color: color("after"), width: 2 }, name: "mean in bins", hovertemplate: "%{y:.3g}" });
    draw(id, parts, { xaxis: { title: { text: plain(one.label) } }, yaxis: { title: { text: plain(label) } } });
  }

  function force(id, content) {
    const select = document.querySelector(`select[data-force="${id}"]`);
    const run = content.runs[Number(select.value)];
    const traces = band(run.t, run.force, run.std.map((v) => (v === null ? null : 2 * v)), "2 std. deviations");
    traces.push({ x: run.t, y: run.force, mode: "lines", line: { color: color("after"), width: 2 }, name: "missing force", hovertemplate: "%{y:.3g}" });
    draw(id + "-time", traces, { xaxis: { title: { text: since(plain(content.t_label), run.since) } }, yaxis: { title: { text: plain(content.label) } } });
    if (content.follows) follows(id + "-follows", content.follows, content.label);
    if (content.map) {
      const one = content.map;
      const limit = Math.max(...one.force.flat().filter((v) => v !== null).map(Math.abs), 1e-300);
      draw(id + "-map", [{
        type: "heatmap", x: one.x, y: one.y, z: one.force, zmin: -limit, zmax: limit, colorscale: "RdBu", reversescale: false, hoverongaps: false,
        colorbar: { title: { text: plain("mean " + content.label), side: "right" }, thickness: 12 }, hovertemplate: "%{z:.3g}<extra></extra>",
      }], { hovermode: "closest", showlegend: false, xaxis: { title: { text: plain(one.x_label) }, showgrid: false, zeroline: false }, yaxis: { title: { text: plain(one.y_label) }, showgrid: false, zeroline: false } });
    }
  }

  function drawAll() {
    if (!window.Plotly) return;
    staircase();
    glance();
    measured();
    data.laws.forEach((law, k) => follows("law-" + k, law.follows, law.label));
    data.forces.forEach((forces, f) => forces.forEach((one, k) => force(`force-${f}-${k}`, one)));
  }

  // Zoom by keyboard: half or twice the width, a quarter of it to either side.
  function zoom(id, what) {
    const place = document.getElementById(id);
    if (what === "whole") {
      Plotly.relayout(place, { "xaxis.autorange": true, "yaxis.autorange": true });
      return;
    }
    const range = place._fullLayout.xaxis.range.map(Number);
    const width = range[1] - range[0];
    const middle = (range[0] + range[1]) / 2;
    const change = { in: [middle - width / 4, middle + width / 4], out: [middle - width, middle + width], left: range.map((v) => v - width / 4), right: range.map((v) => v + width / 4) };
    Plotly.relayout(place, { "xaxis.range": change[what] });
  }
  document.querySelectorAll(".zoom").forEach((group) => group.addEventListener("click", (event) => {
    const what = event.target.dataset.do;
    if (what) zoom(group.dataset.chart, what);
  }));
  document.getElementById("run").addEventListener("change", measured);
  document.getElementById("channel").addEventListener("change", measured);
  document.querySelectorAll("select[data-force]").forEach((select) => select.addEventListener("change", () => {
    const [, f, k] = select.dataset.force.split("-").map(Number);
    force(select.dataset.force, data.forces[f][k]);
  }));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
  drawAll();
  root.dataset.drawn = "yes";
})();
