// Maps by cell: the values of the cell at the pointer, in all maps of a group.
async function inflate(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}
async function unpack(text) {
  const view = new DataView(await inflate(text));
  return Uint16Array.from({ length: view.byteLength / 2 }, (_, i) => view.getUint16(2 * i, true));
}
// The meaning of a packed value.
function valueOf(layer, code, steps) {
  if (layer.names) return layer.names[Math.round((code / steps) * layer.largest)];
  if (code === 0) return "0" + (layer.unit ? " " + layer.unit : "");
  const part = code / steps, digits = layer.digits, least = 10 ** -digits;
  const scaled = part * layer.largest * (layer.unit === "%" ? 100 : 1), unit = layer.unit ? " " + layer.unit : "";
  if (scaled < least) return "< " + written(least, digits) + unit;
  if (layer.unit === "%" && code < steps && scaled > 100 - least) return "> " + written(100 - least, digits) + unit;
  return written(scaled, layer.unit === "%" && code === steps ? 0 : digits) + unit;
}
const tellers = new Map(); // by box: functions with further values of a cell
function maps(group) {
  const about = dataOf(group), [rows, cols] = about.shape, side = about.side, wide = Math.ceil(cols / side);
  const boxes = [...group.querySelectorAll(".grid-box")], marks = boxes.map((box) => box.querySelector(".here"));
  const starts = new Map();
  about.starts.forEach(([row, col], robot) => {
    const key = row + "," + col;
    starts.set(key, [...(starts.get(key) || []), robot]);
  });
  const [east, north, yaw] = about.origin, measured = about.metres !== 1 || east !== 0 || north !== 0 || yaw !== 0;
  const layers = about.from ? dataOf(document.getElementById(about.from)).layers : about.layers;
  let codes = null, asked = false, last = null, cell = null;

  function metres(row, col) {
    const right = (col + 0.5) * about.metres, up = (rows - row - 0.5) * about.metres;
    const digits = about.metres < 1 ? 2 : about.metres < 10 ? 1 : 0;
    const x = east + Math.cos(yaw) * right - Math.sin(yaw) * up, y = north + Math.sin(yaw) * right + Math.cos(yaw) * up;
    return written(x, digits) + " m, " + written(y, digits) + " m";
  }
  hides.push(() => { for (const mark of marks) mark.hidden = true; });

  function point(row, col, from, mouse) {
    cell = [Math.min(Math.max(row, 0), rows - 1), Math.min(Math.max(col, 0), cols - 1)];
    last = [cell[0], cell[1], from, mouse];
    const top = Math.floor(cell[0] / side) * side, left = Math.floor(cell[1] / side) * side;
    for (const mark of marks) {
      mark.hidden = false;
      mark.style.left = (100 * left) / cols + "%";
      mark.style.top = (100 * top) / rows + "%";
      mark.style.width = (100 * Math.min(side, cols - left)) / cols + "%";
      mark.style.height = (100 * Math.min(side, rows - top)) / rows + "%";
    }
    const here = starts.get(cell.join(",")), lines = [];
    if (codes) {
      const found = codes.map((layer) => layer[(top / side) * wide + left / side]);
      if (found[0] === about.steps + 2) lines.push(["", "obstacle", ""]);
      else if (found[0] === about.steps + 1) lines.push(["", "free, out of reach", ""]);
      else layers.forEach((layer, i) => lines.push(["", layer.name, valueOf(layer, found[i], about.steps)]));
    } else lines.push(["", asked === "failed" ? "values need a newer browser" : "...", ""]);
    if (tellers.has(boxes[from])) lines.push(...tellers.get(boxes[from])(...cell));
    if (here) lines.push(["", here.length > 1 ? "start of robots" : "start of robot", here.join(", ")]);
    const title = side > 1
      ? "rows " + top + " to " + (Math.min(top + side, rows) - 1) + ", columns " + left + " to " + (Math.min(left + side, cols) - 1)
      : "row " + cell[0] + ", column " + cell[1];
    if (measured && side === 1) lines.push(["", "x, y", metres(cell[0], cell[1])]);
    const box = boxes[from].getBoundingClientRect();
    const x = mouse ? mouse[0] : box.left + ((cell[1] + 1) / cols) * box.width;
    show(boxes[from], x, mouse ? mouse[1] : box.top + (cell[0] / rows) * box.height, title, lines);
    if (!mouse) {
      marks[from].scrollIntoView({ block: "nearest", inline: "nearest" });
      say(title, lines);
    }
    if (!asked) {
      asked = true;
      Promise.all(layers.map((layer) => unpack(layer.codes)))
        .then((all) => { codes = all; }, () => { asked = "failed"; })
        .then(() => { if (!tip.hidden && last) point(...last); });
    }
  }
  boxes.forEach((box, number) => {
    const under = (event) => {
      const place = box.getBoundingClientRect();
      const row = Math.floor(((event.clientY - place.top) / place.height) * rows);
      const col = Math.floor(((event.clientX - place.left) / place.width) * cols);
      point(row, col, number, [event.clientX, event.clientY]);
    };
    box.addEventListener("pointermove", under);
    box.addEventListener("pointerdown", under);
    box.addEventListener("pointerleave", (event) => { if (event.pointerType === "mouse") hideAll(); });
    box.addEventListener("blur", () => { if (owner === box) hideAll(); });
    box.addEventListener("keydown", (event) => {
      const steps = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] }[event.key];
      if (!steps) return;
      event.preventDefault();
      if (cell) point(cell[0] + steps[0] * side, cell[1] + steps[1] * side, number); else point(0, 0, number);
    });
    if (Math.max(rows, cols) > 40) zoom(box);
  });
}
function zoom(box) {
  const view = box.parentElement, bar = make("div", "zoom");
  let times = 1;
  for (const [sign, name, factor] of [["+", "Larger", 2], ["\u2212", "Smaller", 0.5]]) {
    const button = make("button", "", sign);
    button.type = "button";
    button.setAttribute("aria-label", name);
    button.addEventListener("click", () => {
      const across = (view.scrollLeft + view.clientWidth / 2) / view.scrollWidth;
      const down = (view.scrollTop + view.clientHeight / 2) / view.scrollHeight;
      times = Math.min(Math.max(times * factor, 1), 32);
      view.classList.toggle("zoomed", times > 1);
      view.style.setProperty("--zoom", times);
      view.scrollTo(across * view.scrollWidth - view.clientWidth / 2, down * view.scrollHeight - view.clientHeight / 2); // keeps the centre
    });
    bar.append(button);
  }
  view.before(bar);
}
