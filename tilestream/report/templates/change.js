// What colours the places of a comparison: the change, or the error before or after.
ready.push(() => {
  const map = rootNamed("city-map");
  const choices = document.querySelectorAll("input[name=shown]");

  function colour() {
    const chosen = document.querySelector("input[name=shown]:checked");
    for (const model of map.references()) {
      if (model.type === "ColumnDataSource" && model.data[chosen.value]) {
        model.data = { ...model.data, step: model.data[chosen.value] };
      } else if (model.type === "ColorBar") {
        model.visible = model.name === chosen.dataset.scale;
      }
    }
  }

  if (map && choices.length) {
    choices.forEach((choice) => choice.addEventListener("change", colour));
    colour(); // a browser may have kept another choice
  }
});
