// One place that the page is about. The address names it, `#x=…&y=…` in the map's frame, so that a
// link to it can be sent: the map shows it, and who listens tells more of it.
const entered = []; // told (x, y) of each place

function address(x, y) {
  return `x=${x.toFixed(1)}&y=${y.toFixed(1)}`;
}

function enter(x, y, moves) {
  const map = rootNamed("city-map");
  const [left, low] = map.tags;
  for (const model of map.references()) {
    if (model.name === "here") {
      model.data = { x: [x - left], y: [y - low] };
    }
  }
  if (moves) {
    frame(map, x - left, y - low, 0, 0);
    document.getElementById("map").scrollIntoView();
  }
  entered.forEach((tell) => tell(x, y));
}

ready.push(() => {
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
        location.hash = address(x[nearest], y[nearest]);
      }
    });
  }

  rootsNamed("profile").forEach(listen);
  window.addEventListener("hashchange", () => {
    const at = new URLSearchParams(location.hash.slice(1));
    const [x, y] = [Number.parseFloat(at.get("x")), Number.parseFloat(at.get("y"))];
    if (rootNamed("city-map") && Number.isFinite(x) && Number.isFinite(y)) {
      enter(x, y, true);
    }
  });
});
