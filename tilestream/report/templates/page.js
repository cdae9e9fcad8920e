"use strict";
(() => {
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const printing = window.matchMedia("print");

  function paint() {
    const night = dark.matches && !printing.matches;
    const ink = night ? "#c9ced5" : "#3c434b";
    const line = night ? "#59616b" : "#c3c6c9";
    for (const doc of Bokeh.documents) {
      for (const root of doc.roots()) {
        for (const model of root.references()) {
          if (model.type === "LinearAxis") {
            model.setv({
              axis_label_text_color: ink, major_label_text_color: ink, axis_line_color: line,
              major_tick_line_color: line, axis_label_text_font_style: "normal",
            });
          } else if (model.type === "Grid") {
            model.setv({ grid_line_color: line });
          } else if (model.type === "Legend") {
            model.setv({ label_text_color: ink, inactive_fill_color: night ? "#1d2126" : "#ffffff" });
          } else if (model.type === "ScaleBar") {
            model.setv({ label_text_color: ink });
          } else if (model.type === "Label") {
            model.setv({ text_color: ink });
          } else if (model.type === "ColorBar") {
            model.setv({ title_text_color: ink, major_label_text_color: ink, title_text_font_style: "normal" });
          }
        }
      }
    }
  }

  // Shows the place that the address names, `#x=…&y=…` in the map's frame: a link to it can be sent.
  function go() {
    const at = new URLSearchParams(location.hash.slice(1));
    const map = Bokeh.documents.flatMap((doc) => doc.roots()).find((root) => root.name === "city-map");
    if (!map || !at.has("x") || !at.has("y")) {
      return;
    }
    const [x, y] = [Number(at.get("x")) - map.tags[0], Number(at.get("y")) - map.tags[1]];
    if (!Number.isFinite(x) || !Number.isFinite(y)) {
      return;
    }
    const high = 50;
    const wide = high * (map.inner_width / map.inner_height || 1);
    for (const [range, middle, half] of [[map.x_range, x, wide], [map.y_range, y, high]]) {
      range.have_updated_interactively = true; // as if by the mouse: data no longer move it
      range.setv({ start: middle - half, end: middle + half });
    }
    for (const model of map.references()) {
      if (model.name === "here") {
        model.data = { x: [x], y: [y] };
      }
    }
    document.getElementById("map").scrollIntoView();
  }

  // A click into a profile names the nearest place of it.
  function listen(profile) {
    const places = [...profile.references()].find((model) => model.name === "profile" && model.data);
    profile.on_event("tap", (event) => {
      const { arc, x, y } = places.data;
      let nearest = -1;
      for (let k = 0; k < arc.length; k++) {
        if (Number.isFinite(x[k]) && !(Math.abs(arc[k] - event.x) >= Math.abs(arc[nearest] - event.x))) {
          nearest = k;
        }
      }
      if (nearest >= 0) {
        location.hash = `x=${x[nearest].toFixed(1)}&y=${y[nearest].toFixed(1)}`;
      }
    });
  }

  Bokeh.set_log_level("warn");
  const items = [...document.querySelectorAll("script.chart-data")].map((s) => JSON.parse(s.textContent));
  Promise.all(items.map((item) => Bokeh.embed.embed_item(item))).then(() => {
    paint();
    dark.addEventListener("change", paint);
    window.addEventListener("beforeprint", paint);
    window.addEventListener("afterprint", paint);
    for (const root of Bokeh.documents.flatMap((doc) => doc.roots())) {
      if (root.name === "profile") {
        listen(root);
      }
    }
    window.addEventListener("hashchange", go);
    go();
    document.documentElement.dataset.charts = String(items.length);
  });
})();
