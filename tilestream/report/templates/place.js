// The panel beside the map: what is known of the place that was entered, and what it looks like.
ready.push(() => {
  const panel = document.getElementById("place");
  const map = rootNamed("city-map");
  if (!panel || !map) {
    return;
  }
  const part = (name) => panel.querySelector(`[data-part=${name}]`);
  const worst = JSON.parse(document.getElementById("worst-places").textContent);
  const sources = [...map.references()].filter((model) => model.type === "ColumnDataSource" && model.data.route);
  const profiles = rootsNamed("profile");
  const [left, low] = map.tags;
  let rank = -1; // of the place among the worst; -1: it is none of them
  let turning = false;

  // The dot of the map that is nearest to a position in the map's frame, with all that it says.
  function nearest(x, y) {
    let [found, least] = [null, Infinity];
    for (const { data } of sources) {
      for (let k = 0; k < data.x.length; k++) {
        const distance = Math.hypot(data.x[k] + left - x, data.y[k] + low - y);
        if (distance < least) {
          [found, least] = [Object.fromEntries(Object.entries(data).map(([name, column]) => [name, column[k]])), distance];
        }
      }
    }
    return found;
  }

  function fact(name, value) {
    if (value === undefined || value === "") {
      return [];
    }
    const [term, said] = [document.createElement("dt"), document.createElement("dd")];
    [term.textContent, said.textContent] = [name, value];
    return [term, said];
  }

  // The pictures of the page that are of this place, once more.
  function pictures(figures, is) {
    return [...document.querySelectorAll(figures)].filter((figure) => is(figure.dataset)).flatMap((figure) => {
      const image = figure.querySelector("img");
      return image ? [image.cloneNode()] : [];
    });
  }

  async function turn() {
    const number = rank < 0 ? 0 : worst[rank].number;
    const holder = document.querySelector(`script.cloud[data-place="${number}"]`);
    part("turn").hidden = !holder || turning;
    part("cloud").hidden = !holder || !turning;
    part("around").hidden = Boolean(holder) && turning;
    if (holder && turning) {
      try {
        await drawCloud(holder.textContent, part("cloud"));
      } catch (error) {
        part("cloud").textContent = `This browser shows nothing in 3D: ${error.message}`;
      }
    }
  }

  function show(x, y) {
    const found = nearest(x, y);
    if (!found) {
      return;
    }
    rank = worst.findIndex((one) => Math.hypot(one.x - x, one.y - y) < 0.1);
    part("which").textContent = rank < 0 ? "not one of the worst" : `worst place ${worst[rank].number} of ${worst.length}`;
    part("where").textContent = `${found.route}, ${found.arc.toFixed(0)} m along`;
    part("facts").replaceChildren(
      ...fact("estimate", found.shown), ...fact("interval", found.interval), ...fact("by direction", found.axes),
      ...fact("starts", found.starts), ...fact("starts that fail", found.fail),
      ...fact("95 % ellipse", found.ellipse), ...fact("lost", found.lost), ...fact("NVTL", found.nvtl), ...fact("TP", found.tp),
      ...fact("like the training places", found.domain), ...fact("why", found.reason),
      ...fact("x, y", `${x.toFixed(1)}, ${y.toFixed(1)}`),
    );
    part("filter").hidden = !found.ellipse;
    part("link").href = `#${address(x, y)}`;
    part("link").hidden = false;
    const around = pictures("figure[data-x]", (of) => Math.hypot(of.x - x, of.y - y) < 0.1);
    const ends = pictures("figure[data-route]", (of) => of.route === found.route && Math.abs(of.arc - found.arc) < 0.5);
    part("around").replaceChildren(...around);
    part("ends").replaceChildren(...ends);
    part("none").hidden = around.length + ends.length > 0;
    for (const profile of profiles) {
      const line = [...profile.references()].find((model) => model.name === "here");
      line.setv({ location: found.arc, visible: profile.tags[0] === found.route });
    }
    turn();
  }

  function step(by) {
    const from = rank < 0 && by < 0 ? 0 : rank;
    const next = worst[(from + by + worst.length) % worst.length];
    location.hash = address(next.x, next.y);
  }

  map.on_event("tap", (event) => {
    const found = nearest(event.x + left, event.y + low);
    const pixel = (map.x_range.end - map.x_range.start) / map.inner_width;
    if (found && Math.hypot(found.x - event.x, found.y - event.y) < 15 * pixel) {
      location.hash = address(found.x + left, found.y + low);
    }
  });
  for (const [name, by] of [["previous", -1], ["next", 1]]) {
    part(name).hidden = worst.length < 2;
    part(name).addEventListener("click", () => step(by));
  }
  part("turn").addEventListener("click", () => {
    turning = true;
    turn();
  });
  entered.push(show);
  if (worst.length) {
    enter(worst[0].x, worst[0].y, false);
  }
});
