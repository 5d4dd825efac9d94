(async function () {
  const root = document.documentElement;

  // Colours: as the system has them, or one of two; kept while the page is open.
  document.getElementById("theme").addEventListener("change", (event) => { root.style.colorScheme = event.target.value;
    });

  // On a phone the answers come first; what stands behind them is opened.
  if (matchMedia("(max-width: 40rem)").matches) {
    document.querySelectorAll(".facts > div:not(:last-child) details").forEach((one) => { one.open = false; });
  }

  // On paper nothing can be opened: everything is.
  window.addEventListener("beforeprint", function () {
    document.querySelectorAll("details").forEach((one) => { one.open = true; });
  });

  async function unpacked(id) {
    const packed = atob(document.getElementById(id).textContent);
    const bytes = Uint8Array.from(packed, (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).text();
  }
  let charts;
  try {
    charts = JSON.parse(await unpacked("packed"));
  } catch (error) {
    return; // the static pictures stay
  }
  root.classList.add("charts");

  // Of several figures of one place, that of the run and channel that are chosen.
  function chosen(id) {
    if (!Array.isArray(charts[id])) return charts[id];
    const [run, channel] = ["run", "channel"].map((what) => {
      const select = document.querySelector(`select[data-chart="${id}"][data-what="${what}"]`);
      return select ? Number(select.value) : 0;
    });
    return charts[id][run][channel];
  }
  const drawn = {};
  function draw(id) {
    if (drawn[id]) drawn[id].stop();
    drawn[id] = phsiChart(document.getElementById(id), chosen(id));
  }
  document.querySelectorAll("select[data-chart]").forEach((select) => select.addEventListener("change", () =>
    draw(select.dataset.chart)));
  Object.keys(charts).forEach(draw);
  root.dataset.drawn = "yes";
})();
