// The search above the map: which places it shows, and which rows of the tables.
ready.push(() => {
  const form = document.getElementById("choose");
  const map = rootNamed("city-map");
  if (!form || !map) {
    return;
  }
  const told = document.getElementById("chosen");
  const glyphs = map.renderers.filter((one) => one.view && one.view.filter.type === "BooleanFilter");

  function wanted() {
    const text = form.elements.text.value.trim().toLowerCase();
    const least = Number(form.elements.least.value) || 0;
    const kind = form.elements.kind.value;
    return (route, reason, error, kinds) =>
      (text === "" || `${route} ${reason}`.toLowerCase().includes(text)) &&
      (least === 0 || error >= least) &&
      (kind === "" || kinds.includes(kind));
  }

  function choose() {
    const is = wanted();
    const everything = form.elements.text.value.trim() === "" && !Number(form.elements.least.value) && form.elements.kind.value === "";
    let [shown, all] = [0, 0];
    const [xs, ys] = [[], []];
    for (const glyph of glyphs) {
      const source = glyph.data_source;
      const { x, y, route, reason, estimate, measured } = source.data;
      const error = source.name === "measured" ? measured : estimate;
      const kept = Array.from(x, (_, k) => is(route[k], reason[k], error[k], [source.name]));
      glyph.view.filter.booleans = kept;
      for (let k = 0; k < kept.length; k++) {
        if (kept[k]) {
          xs.push(x[k]);
          ys.push(y[k]);
        }
      }
      if (source.name !== "measured" || form.elements.kind.value === "measured") {
        shown += kept.filter(Boolean).length;
      }
      all += source.name === "measured" ? 0 : kept.length;
    }
    for (const row of document.querySelectorAll("tr[data-route]")) {
      const { route, reason, error, kinds } = row.dataset;
      row.hidden = !is(route, reason, Number(error), kinds.split(" "));
    }
    told.textContent = everything ? "" : `${shown} of ${all} dots of the map are shown.`;
    const ends = (values) => values.reduce(([low, high], v) => [Math.min(low, v), Math.max(high, v)], [Infinity, -Infinity]);
    if (shown && !everything) {
      const [[left, right], [low, high]] = [ends(xs), ends(ys)];
      frame(map, (left + right) / 2, (low + high) / 2, right - left, high - low);
    }
  }

  form.hidden = false;
  form.addEventListener("input", choose);
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("reset", () => setTimeout(() => {
    choose();
    map.reset.emit();
  }));
});
