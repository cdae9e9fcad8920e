"use strict";
const ready = []; // what begins as soon as the charts are drawn

function rootsNamed(name) {
  return Bokeh.documents.flatMap((doc) => doc.roots()).filter((root) => root.name === name);
}

function rootNamed(name) {
  return rootsNamed(name)[0];
}

// Shows so much of a map round a point, and at least the streets beside it; axes stay equal.
function frame(map, x, y, width, height) {
  const ratio = map.inner_width / map.inner_height || 1;
  const high = Math.max(0.6 * height, (0.6 * width) / ratio, 50);
  for (const [range, middle, half] of [[map.x_range, x, high * ratio], [map.y_range, y, high]]) {
    range.have_updated_interactively = true; // as if by the mouse: data no longer move it
    range.setv({ start: middle - half, end: middle + half });
  }
}

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

  Bokeh.set_log_level("warn");
  const items = [...document.querySelectorAll("script.chart-data")].map((s) => JSON.parse(s.textContent));
  Promise.all(items.map((item) => Bokeh.embed.embed_item(item))).then(() => {
    paint();
    dark.addEventListener("change", paint);
    window.addEventListener("beforeprint", paint);
    window.addEventListener("afterprint", paint);
    ready.forEach((begin) => begin());
    window.dispatchEvent(new Event("hashchange")); // the place that the address names already
    document.documentElement.dataset.charts = String(items.length);
  });
})();
