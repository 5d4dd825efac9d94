"use strict";
// Draws a chart of Python's `Chart` into an element, as SVG: hover, legend, zoom, files.
function phsiChart(host, chart) {
  const DASHES = { dash: "7 4", dot: "2 4" }, LEFT = 62, RIGHT = 12, GAP = 22;
  const RAISED = { ..."⁰¹²³⁴⁵⁶⁷⁸⁹", "-": "⁻" };
  const TOOLS = { in: ["+", "Zoom in", 1, -1], out: ["−", "Zoom out", -2, 2], left: ["←", "Move to the left", -2, -2],
    right: ["→", "Move to the right", 2, 2], whole: ["Reset", "Reset the zoom", 4, -4], svg: ["SVG",
      "Save the figure as SVG"], png: ["PNG", "Save the figure as PNG"], csv: ["CSV", "Save the numbers as CSV"] };
  const plain = (text) => String(text).replace(/[&<>"']/g, (sign) => `&#${sign.charCodeAt(0)};`);
  const finite = (values) => values.filter((value) => value !== null && isFinite(value));
  const curves = chart.panels.flatMap((panel) => panel.curves);
  const hidden = new Set(curves.filter((curve) => !curve.is_shown).map((curve) => curve.group || curve.name));
  const seen = (panel) => panel.curves.filter((curve) => !hidden.has(curve.group || curve.name));
  const whole = chart.ticks.length ? [-0.5, chart.ticks.length - 0.5] : reach(curves.flatMap((curve) => ends(curve.x)));
  const spanOf = (x) => chart.spans.find((span) => x > span.low - 1e-5 && x < span.high + 1e-5);
  const time = (span, x) => { // with the decimals that the axis tells
    const long = span.end - span.begin, t = span.begin + (x - span.low) / (span.high - span.low) * long;
    return Number(t.toFixed(Math.max(4 - Math.floor(Math.log10(long)), 0)));
  };
  const size = () => `${host.clientWidth} ${host.clientHeight}`;
  let range = whole, drawnAt = "";

  function ends(values) {
    let [low, high] = [Infinity, -Infinity];
    for (const value of values) if (value !== null) [low, high] = [Math.min(low, value), Math.max(high, value)];
    return low <= high ? [low, high] : [];
  }
  function reach(values) {
    const [low = 0, high = 1] = ends(values);
    return low < high ? [low, high] : [low - (Math.abs(low) || 1) / 2, high + (Math.abs(high) || 1) / 2];
  }
  function said(value, digits = 4) {
    const text = (Math.abs(value) >= 1e6 && digits < 7) || (value && Math.abs(value) < 1e-4) ?
      Number(value.toPrecision(3)).toExponential() : String(Number(value.toPrecision(digits)));
    return text.replace(/e\+?(-?\d+)/, (_, power) => `×10${[...power].map((one) =>
      RAISED[one]).join("")}`).replace(/-/g, "−");
  }
  function ticks(low, high, most) {
    const rough = (high - low) / most, size = 10 ** Math.floor(Math.log10(rough));
    const step = size * [1, 2, 5, 10].find((factor) => factor * size >= rough);
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
    if (found.length < 2) return ticks(low, high, 2 * most);
    found.digits = 1 + Math.ceil(Math.log10(Math.max(...found.map(Math.abs)) / step)); // that tell them apart
    return found;
  }
  function decades(low, high) {
    const found = [];
    for (let k = Math.floor(low); k <= high; k++) for (const one of high - low > 2 ? [1] : [1, 2, 5]) found.push(k +
      Math.log10(one));
    return found.filter((value) => value >= low && value <= high);
  }
  function folded(text, most) { // into lines of so many letters
    const lines = [""];
    for (let word of text.split(" ")) {
      if (word.length > most) word = `${word.slice(0, Math.max(most - 1, 1))}…`;
      const longer = `${lines[lines.length - 1]} ${word}`.trim();
      longer.length > most && lines[lines.length - 1] ? lines.push(word) : (lines[lines.length - 1] = longer);
    }
    return lines;
  }
  function limits(panel) {
    const log = panel.scale === "log", values = panel.noise ? [-panel.noise, panel.noise] : [];
    for (const curve of seen(panel)) {
      curve.y.forEach((y, k) => {
        if (y === null || curve.x[k] < range[0] || curve.x[k] > range[1] || (log && y <= 0)) return;
        const half = curve.std ? curve.std[k] || 0 : 0;
        values.push(log ? Math.log10(y) : y - half, log ? Math.log10(y) : y + half);
      });
    }
    if (panel.scale === "from zero") values.push(0);
    const [low, high] = reach(values), room = (high - low) * (panel.curves.some((curve) => curve.texts.length) ? 0.2 :
      0.06);
    return [panel.scale === "from zero" ? 0 : low - room, high + room];
  }
  function path(curve, x, y, height) {
    let text = "", pen = "M";
    curve.y.forEach((value, k) => {
      const at = value === null ? NaN : y(value);
      if (!isFinite(at)) { pen = "M"; return; }
      text += `${pen}${x(curve.x[k]).toFixed(1)} ${Math.max(-999, Math.min(height + 999, at)).toFixed(1)}`;
      pen = "L";
    });
    return text;
  }
  function drawn(curve, x, y, height) {
    let svg = "";
    if (curve.std) {
      const known = curve.y.map((value, k) => k).filter((k) => curve.y[k] !== null && curve.std[k] !== null);
      const side = (sign) => known.map((k) => `${x(curve.x[k]).toFixed(1)} ${y(curve.y[k] +
        sign * curve.std[k]).toFixed(1)}`);
      svg += `<polygon points="${[...side(1),
        ...side(-1).reverse()].join(" ")}" fill="${curve.color}" `
        + `fill-opacity=".2"${curve.look === "band" ? ` stroke="${curve.color}"` : ""}/>`;
    }
    const isRings = curve.look === "rings", isPoints = curve.look === "points";
    if (isPoints) { // one element for all of them: hundreds take a browser long
      const dots = curve.y.flatMap((value, k) => value === null || !isFinite(y(value)) ? [] :
        `M${x(curve.x[k]).toFixed(1)} ${y(value).toFixed(1)}h0`);
      return `${svg}<path d="${dots.join("")}" stroke="${curve.color}" stroke-width="3.6" stroke-linecap="round"/>`;
    }
    if (!isRings && curve.look !== "band") svg += `<path d="${path(curve, x, y,
      height)}" fill="none" stroke="${curve.color}" stroke-width="2" stroke-dasharray="${DASHES[curve.look] || ""}"/>`;
    if (!isRings && curve.look !== "steps") return svg;
    curve.y.forEach((value, k) => {
      if (value === null || !isFinite(y(value))) return;
      const [cx, cy] = [x(curve.x[k]).toFixed(1), y(value)];
      svg += `<circle cx="${cx}" cy="${cy.toFixed(1)}" r="${isRings ? 6 : 4}" ${isRings ?
        'fill="none" stroke-width="2" stroke' : "fill"}="${curve.color}"/>`;
      const text = curve.texts[k] || "";
      const places = curve.is_below[k] ? [cy + 18, cy - 9] : [cy - 9, cy + 18];
      svg += text && `<text x="${cx}" y="${places[0]}" data-or="${places[1]}" text-anchor="middle" style="fill: ${
        curve.color}">${plain(text)}</text>`;
    });
    return svg;
  }
  function legend() {
    const named = new Map();
    for (const curve of curves) {
      if (curve.name && !named.has(curve.name)) named.set(curve.name, curve);
      if (curve.std) named.set(curve.band, { ...curve, look: "band" });
    }
    const keys = [...named].map(([name, curve]) => {
      const line = curve.look === "points" ? "dotted 4px" : curve.look === "band" ? "solid 9px" : { dash: "dashed 3px",
        dot: "dotted 3px" }[curve.look] || "solid 3px";
      const key = `<i style="border-top: ${line} ${curve.color}${curve.look === "band" ? "55" :
        ""}"></i>${plain(name)}`;
      return curve.look === "band" ? `<span>${key}</span>` :
        `<button type="button" aria-pressed="${!hidden.has(name)}" data-name="${plain(name)}">${key}</button>`;
    });
    const noisy = chart.panels.find((panel) => panel.noise);
    if (noisy) keys.push(`<span><i class="noise"></i>${plain(noisy.band)}</span>`);
    for (const [name, color] of new Map(chart.spans.map((span) => [span.shade, span.color]))) {
      if (name) keys.push(`<span><i style="border-top: solid 9px ${color}55"></i>${plain(name)}</span>`);
    }
    return `<div class="keys">${keys.join("")}</div>`;
  }
  function draw() {
    const width = host.clientWidth, panels = chart.panels;
    if (width <= LEFT + RIGHT) return;
    const names = chart.ticks.map((lines) => folded(lines.join(" "),
      (width - LEFT - RIGHT) / 6.5 / chart.ticks.filter((one) => one.length).length));
    const box = host.querySelector("svg"), tickRows = Math.max(1, ...names.map((lines) => lines.length));
    const label = folded(chart.x_label, width / 6.5), head = chart.mark ? 34 : 18;
    const keys = host.querySelector(".keys").offsetHeight + 4;
    const below = 18 * tickRows + (chart.x_label ? 5 + 17 * label.length : 4);
    host.style.minHeight = `${keys + head + 75 * panels.length + below}px`; // texts take no room from curves
    drawnAt = size();
    const height = host.clientHeight - keys, bottom = height - below;
    const x = (value) => LEFT + (value - range[0]) / (range[1] - range[0]) * (width - LEFT - RIGHT);
    const room = bottom - head - GAP * (panels.length - 1), heights = panels.reduce((sum, panel) => sum +
      panel.height, 0);
    let top = head, svg = "";
    panels.forEach((panel) => {
      const high = room * panel.height / heights, [least, most] = limits(panel), log = panel.scale === "log";
      const y = (value) => top + high - ((log ? Math.log10(value) : value) - least) / (most - least) * high;
      const marks = log ? decades(least, most) : ticks(least, most, Math.max(high / 35, 3));
      marks.forEach((mark) => {
        const at = y(log ? 10 ** mark : mark);
        svg += `<line x1="${LEFT}" x2="${width - RIGHT}" y1="${at}" y2="${at}" class="${mark === 0 && !log ? "zero" :
          "grid"}"/><text x="${LEFT - 6}" y="${at + 4}" text-anchor="end">${said(log ? 10 ** mark : mark,
          marks.digits)}</text>`;
      });
      svg += `<text x="2" y="${top - 6}" class="name">${plain(panel.label)}</text><g clip-path="inset(0)">`
        + `<svg x="${LEFT}" y="${top - 6}" width="${width - LEFT - RIGHT}" height="${high + 12}" `
        + `viewBox="${LEFT} ${top - 6} ${width - LEFT - RIGHT} ${high + 12}">`;
      for (const span of chart.spans) if (span.shade) svg += `<rect x="${x(span.low)}" width="${x(span.high) -
        x(span.low)}" y="${top - 6}" height="${high + 12}" fill="${span.color}" fill-opacity=".2"/>`;
      if (panel.noise) svg += `<rect x="${LEFT}" width="${width}" y="${y(panel.noise)}" `
        + `height="${y(-panel.noise) - y(panel.noise)}" class="noise"/>`;
      svg += seen(panel).map((curve) => drawn(curve, x, y, height)).join("");
      if (chart.mark) svg += `<line x1="${x(chart.mark[0])}" x2="${x(chart.mark[0])}" y1="${top}" y2="${top +
        high}" class="mark"/>`;
      svg += "</svg></g>";
      top += high + GAP;
    });
    if (chart.mark) svg += `<text x="${x(chart.mark[0])}" y="28" text-anchor="middle">${plain(chart.mark[1])}</text>`;
    const at = ticks(...range, Math.max((width - LEFT) / 80, 4));
    const marked = names.length ? names.map((lines, k) => [k, lines]).filter(([k]) => k >= range[0] && k <= range[1]) :
      at.map((value) => [value, [said(value, at.digits)]]);
    marked.forEach(([value, lines]) => lines.forEach((line, row) => { svg += `<text x="${x(value)}" y="${bottom + 16 +
      17 * row}" text-anchor="middle"${names.length ? ' class="name"' : ""}>${plain(line)}</text>`; }));
    svg += label.map((line, row) => `<text x="${(LEFT + width - RIGHT) / 2}" y="${height - 5 - 17 * (label.length - 1 -
      row)}" text-anchor="middle" class="name">${plain(line)}</text>`).join("")
      + `<line class="cursor" x1="-9" x2="-9" y1="18" y2="${bottom}"/><rect class="drag" y="18" height="${bottom - 18}"/>`;
    box.setAttribute("height", height);
    box.innerHTML = svg;
    apart(width);
  }
  function apart(width) { // no text is cut at an edge, or covers another: then it goes, to its other place or away
    const kept = [], overlaps = (a) => kept.some((b) => a.x < b.x + b.width && b.x < a.x + a.width &&
      a.y < b.y + b.height && b.y < a.y + a.height);
    for (const text of [".name", "text:not(.name, [data-or])", "[data-or]"].flatMap((one) => [
      ...box.querySelectorAll(one)])) {
      while (text.getBBox().width > width) text.textContent = `${text.textContent.slice(0, -2)}…`;
      const { x, width: own } = text.getBBox();
      text.setAttribute("x", Number(text.getAttribute("x")) - Math.min(x, 0) - Math.max(x + own - width, 0));
      if (overlaps(text.getBBox()) && text.dataset.or) text.setAttribute("y", text.dataset.or);
      overlaps(text.getBBox()) ? text.remove() : kept.push(text.getBBox());
    }
  }

  // ---- files: the figure, and its numbers --------------------------------------------
  function save(blob, kind) {
    const link = document.createElement("a"), title = `${chart.title} ${chart.panels[0].label}`;
    link.href = URL.createObjectURL(blob);
    link.download = `${title.replace(/[^\p{L}\p{N}]+/gu, "_").replace(/^_|_$/g, "")}.${kind}`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60000);
  }
  function picture() { // with its legend where it stands, on white
    const at = host.getBoundingClientRect(), [width, height] = [host.clientWidth, host.clientHeight];
    const keys = [...host.querySelectorAll(".keys > :not([aria-pressed=false])")].map((one) => {
      const box = one.firstChild.getBoundingClientRect(), look = getComputedStyle(one.firstChild);
      const [x, y] = [box.left - at.left, box.top - at.top + box.height / 2], line = parseFloat(look.borderTopWidth);
      return `<line x1="${x}" x2="${x + box.width}" y1="${y}" y2="${y}" stroke="${line ? look.borderTopColor :
        look.backgroundColor}" stroke-width="${line || box.height}" stroke-opacity="${look.opacity}" stroke-dasharray="${{ dotted: "3 3",
        dashed: "7 4" }[look.borderTopStyle] || ""}"/><text x="${x + box.width + 6}" y="${y +
        4}">${plain(one.textContent)}</text>`;
    });
    return `<svg xmlns="${box.namespaceURI}" width="${width}" height="${height}"><style>text { font: 12px
      sans-serif; } .grid { stroke: #ccc; } .zero { stroke: #555; } .noise { fill: #3b8f5a; opacity: .2; }
      .mark { stroke: #b5459e; stroke-width: 2; stroke-dasharray: 7 4; } .drag, .cursor { display: none; }</style>
      <rect width="100%" height="100%" fill="#fff"/>${keys.join("")}<g transform="translate(0 ${
      box.getBoundingClientRect().top - at.top})">${box.innerHTML}</g></svg>`;
  }
  function photograph() { // twice as large, for paper
    const image = new Image(), canvas = document.createElement("canvas");
    image.onload = () => {
      Object.assign(canvas, { width: 2 * image.width, height: 2 * image.height });
      canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
      canvas.toBlob((blob) => save(blob, "png"));
    };
    image.src = `data:image/svg+xml,${encodeURIComponent(picture())}`;
  }
  function numbers() { // a line for each place on the axis, a column for each curve and each band
    const rows = new Map(), names = chart.spans.length ? ["run", chart.time] : [chart.x_label || "step"];
    const quoted = (text) => `"${text.replace(/"/g, '""')}"`;
    for (const panel of chart.panels) for (const curve of panel.curves) for (const band of curve.std ? [0, 1] : [0]) {
      const met = new Map(), name = [curve.name || curve.group, panel.label].filter(Boolean).join(", ");
      names.push(band ? `${name}, half of the band` : name);
      curve.y.forEach((y, k) => { // of a jump the value after it, of points all
        const x = curve.x[k], nth = (curve.look === "points" && met.get(x)) || 0, key = `${x} ${nth}`, span = spanOf(x);
        if (y === null || (names[0] === "step" && x % 1)) return;
        const begin = span ? [quoted(span.name), time(span, x)] : [x];
        if (!rows.has(key)) rows.set(key, Object.assign(begin, { x, nth }));
        rows.get(key)[names.length - 1] = band ? curve.std[k] : y;
        met.set(x, nth + 1);
      });
    }
    const lines = [...rows.values()].sort((a, b) => a.x - b.x || a.nth - b.nth).map((row) =>
      names.map((_, k) => row[k] ?? "").join(","));
    return [names.map(quoted).join(","), ...lines, ""].join("\n");
  }

  // ---- what a reader does: hover, drag, the legend, and the zoom of buttons ----------
  host.classList.add("drawn");
  const tools = Object.entries(TOOLS).map(([name, [text, told]]) => `<button type="button" data-do="${name}" title="${
    told}" aria-label="${told}">${text}</button>`);
  host.innerHTML = `${legend()}<div class="tools" role="group" aria-label="Zoom and save">${tools.join("")}</div>`
    + `<svg width="100%" role="img" aria-label="${plain(host.dataset.label)}"></svg><output hidden></output>`;
  const box = host.querySelector("svg"), told = host.querySelector("output");
  const inside = (event) => event.clientX - box.getBoundingClientRect().left;
  const value = (pixel) => range[0] + (Math.min(Math.max(pixel, LEFT),
    host.clientWidth - RIGHT) - LEFT) / (host.clientWidth - LEFT - RIGHT) * (range[1] - range[0]);
  const nearest = (curve, at) => curve.x.reduce((best, x, k) => curve.y[k] !== null && (best < 0 ||
    Math.abs(x - at) < Math.abs(curve.x[best] - at)) ? k : best, -1);
  let from = null;
  function zoom(low, high) {
    range = low < high ? [low, high] : whole;
    draw();
    const times = range.map((one) => one * chart.clock), digits = 3 - Math.floor(Math.log10(times[1] - times[0]));
    const detail = range === whole || !chart.clock ? [] : times.map((one) => Number(one.toFixed(Math.max(digits, 0))));
    host.dispatchEvent(new CustomEvent("stretch", { detail }));
  }
  box.addEventListener("pointerdown", (event) => { from = inside(event); });
  box.addEventListener("pointermove", (event) => {
    const at = inside(event), cursor = box.querySelector(".cursor"), drag = box.querySelector(".drag");
    if (!cursor) return;
    if (event.buttons && from !== null) {
      drag.setAttribute("x", Math.min(from, at));
      drag.setAttribute("width", Math.abs(at - from));
    }
    const rows = chart.panels.flatMap((panel) => seen(panel).map((curve) => [curve, nearest(curve, value(at)),
      panel.label])).filter(([, k]) => k >= 0);
    if (!rows.length) return;
    const x = rows[0][0].x[rows[0][1]], span = spanOf(x);
    const title = span ? `${span.name}, ${chart.time}: ${said(time(span, x))}` : chart.ticks.length ?
      chart.ticks[Math.round(x)].join(" ") : `${chart.x_label}: ${said(x)}`;
    told.innerHTML = `${plain(title)}<br>` + rows.map(([curve, k, label]) =>
      `<i style="border-top: solid 3px ${curve.color}"></i>${plain(curve.look === "band" ? curve.band : curve.name ||
      (curve.group ? `residual, ${curve.group}` : label))} ${curve.look === "band" ? "" :
      said(curve.y[k])}`).join("<br>");
    told.hidden = false;
    told.style.left = `${Math.max(Math.min(at + 14, host.clientWidth - told.offsetWidth - 4), 0)}px`;
    cursor.setAttribute("x1", at);
    cursor.setAttribute("x2", at);
  });
  box.addEventListener("pointerup", (event) => {
    const at = inside(event);
    if (from !== null && Math.abs(at - from) > 8) zoom(...[value(from), value(at)].sort((a, b) => a - b));
    else host.dispatchEvent(new CustomEvent("moment", { detail: Number(value(at).toPrecision(5)) }));
    from = null;
  });
  box.addEventListener("pointerleave", () => {
    told.hidden = true;
    ["x1", "x2"].forEach((end) => box.querySelector(".cursor").setAttribute(end, -9));
  });
  box.addEventListener("dblclick", () => zoom(0, 0));
  host.addEventListener("click", (event) => {
    const key = event.target.closest("button[data-name]"), what = event.target.dataset.do, [low, high] = range;
    const [, , left, right] = TOOLS[what] || [], quarter = (high - low) / 4;
    if (left) zoom(low + left * quarter, high + right * quarter);
    if (what === "svg") save(new Blob([picture()], { type: "image/svg+xml" }), what);
    if (what === "png") photograph();
    if (what === "csv") save(new Blob([numbers()], { type: "text/csv" }), what);
    if (!key) return;
    const name = key.dataset.name;
    if (!hidden.delete(name)) hidden.add(name);
    key.setAttribute("aria-pressed", !hidden.has(name));
    draw();
  });
  const watch = new ResizeObserver(() => { if (size() !== drawnAt) draw(); });
  watch.observe(host);
  draw();
  return { stop: () => watch.disconnect() };
}
// A page that puts charts in and takes them out has each in ``data-figure``.
new MutationObserver(() => document.querySelectorAll("[data-figure]:not(.drawn)").forEach((host) => phsiChart(host,
  JSON.parse(host.dataset.figure)))).observe(document.documentElement, { childList: true, subtree: true });
