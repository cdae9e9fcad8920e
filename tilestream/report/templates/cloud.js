// Point clouds that turn, by K3D. Its script is unpacked when the first of them is asked for.
let drawCloud;
{
  const bytesOf = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  let [k3d, view, asked] = [null, null, 0];

  async function unpacked(text) {
    const stream = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).text();
  }

  async function load() {
    const script = document.createElement("script");
    script.textContent = await unpacked(document.getElementById("k3d").textContent);
    window.define = (name, needs, make) => {
      k3d = make();
    };
    document.head.append(script); // runs at once: the page's policy knows its text
    delete window.define;
  }

  drawCloud = async (snapshot, element) => {
    const mine = ++asked;
    if (!k3d) {
      await load();
    }
    if (mine !== asked) {
      return; // another one was asked for meanwhile
    }
    if (view) {
      view.disable();
    }
    element.replaceChildren();
    const drawn = document.createElement("div");
    drawn.className = "drawn";
    element.append(drawn);
    view = await k3d.CreateK3DAndLoadBinarySnapshot(bytesOf(snapshot).buffer, drawn);
  };
}
