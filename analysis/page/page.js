"use strict";
// Values under the pointer, the finger or the arrow keys. Everything can be read without this script.
(() => {
  const tip = document.getElementById("tip"), live = document.getElementById("live");
  const make = (name, look, text) => {
    const made = document.createElement(name);
    if (look) made.className = look;
    if (text !== undefined) made.textContent = text;
    return made;
  };
  const written = (value, digits) =>
    value.toLocaleString("en-US", { minimumFractionDigits: digits, maximumFractionDigits: digits });
  const dataOf = (box) => JSON.parse(box.querySelector('script[type="application/json"]').textContent);

  // --- the box with the values ---
  let owner = null;
  function show(whose, x, y, title, lines, below) {
    owner = whose;
    tip.replaceChildren(make("b", "", title), ...lines.map(([look, name, value, more]) => {
      const line = make("div"), last = make("span", "", value);
      if (more) last.append(" ", make("small", "", more));
      if (look) line.append(make("i", "swatch " + look));
      line.append(make("span", "", name), last);
      return line;
    }));
    tip.hidden = false;
    const box = tip.getBoundingClientRect(), gap = 14;
    let left = x + gap, top = y - box.height - gap;
    if (left + box.width > innerWidth - 6) left = Math.max(6, x - gap - box.width);
    if (top < 6) top = Math.min(y + gap, innerHeight - box.height - 6);
    if (below && innerWidth < 640 && below + box.height < innerHeight - 6) top = below; // never over the curve
    tip.style.left = left + "px";
    tip.style.top = Math.max(6, top) + "px";
  }
  function say(title, lines) {
    live.textContent = title + ": " + lines.map((l) => l[1] + " " + l[2] + (l[3] ? " " + l[3] : "")).join("; ");
  }
  const hides = [];
  const hideAll = () => { tip.hidden = true; for (const hide of hides) hide(); };
  addEventListener("scroll", (event) => { if (event.target === document) hideAll(); }, { passive: true, capture: true });
  addEventListener("keydown", (event) => { if (event.key === "Escape") hideAll(); });
  addEventListener("pointerdown", (event) => { if (!event.target.closest(".plot, .grid-box")) hideAll(); });

  // --- curves ---
  function chart(figure) {
    const plot = figure.querySelector(".plot"), cursor = plot.querySelector(".cursor");
    const about = dataOf(plot), off = new Set();
    const every = [...new Set(about.series.flatMap((s) => s.x))].sort((a, b) => a - b);
    const across = (x) => (x - about.x[0]) / (about.x[1] - about.x[0]);
    const up = (y) => (y - about.y[0]) / (about.y[1] - about.y[0]);
    let at = -1;
    hides.push(() => { cursor.hidden = true; });

    function point(place, mouse) {
      at = Math.min(Math.max(place, 0), every.length - 1);
      const x = every[at], lines = [], unit = about.unit ? " " + about.unit : "";
      cursor.replaceChildren();
      about.series.forEach((s, number) => {
        const i = s.x.indexOf(x);
        if (i < 0 || off.has(number)) return;
        const ranged = s.low && s.low[i] !== s.high[i];
        const more = ranged ? "(" + written(s.low[i], about.digits) + " .. " + written(s.high[i], about.digits) + ")" : "";
        lines.push(["s" + s.colour, s.name, written(s.y[i], about.digits) + unit, more]);
        const dot = make("i", "s" + s.colour);
        dot.style.top = 100 * (1 - up(s.y[i])) + "%";
        cursor.append(dot);
      });
      cursor.hidden = false;
      cursor.style.left = 100 * across(x) + "%";
      const title = about.xName.split("(")[0].trim() + " " + written(x, about.xDigits), box = plot.getBoundingClientRect();
      show(plot, box.left + across(x) * box.width, mouse === undefined ? box.top + box.height / 3 : mouse, title, lines,
        box.bottom + 24);
      if (mouse === undefined) say(title, lines);
    }
    function nearest(event) {
      const box = plot.getBoundingClientRect();
      const x = about.x[0] + ((event.clientX - box.left) / box.width) * (about.x[1] - about.x[0]);
      let best = 0;
      for (let i = 1; i < every.length; i++) if (Math.abs(every[i] - x) < Math.abs(every[best] - x)) best = i;
      point(best, event.clientY);
    }
    plot.addEventListener("pointermove", nearest);
    plot.addEventListener("pointerdown", nearest);
    plot.addEventListener("pointerleave", (event) => { if (event.pointerType === "mouse") hideAll(); });
    plot.addEventListener("blur", () => { if (owner === plot) hideAll(); });
    plot.addEventListener("keydown", (event) => {
      const one = event.shiftKey ? Math.max(1, Math.round(every.length / 10)) : 1;
      const steps = { ArrowRight: one, ArrowLeft: -one, Home: -1e9, End: 1e9 };
      if (!(event.key in steps)) return;
      event.preventDefault();
      point(at < 0 ? 0 : at + steps[event.key]);
    });
    for (const button of figure.querySelectorAll(".legend button")) {
      button.addEventListener("click", () => {
        const number = +button.dataset.series, on = off.has(number);
        if (on) off.delete(number); else off.add(number);
        button.setAttribute("aria-pressed", on);
        plot.querySelector('.series[data-series="' + number + '"]').toggleAttribute("hidden", !on);
      });
    }
  }

  // --- maps by cell ---
  async function unpack(text) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const view = new DataView(await new Response(stream).arrayBuffer());
    return Uint16Array.from({ length: view.byteLength / 2 }, (_, i) => view.getUint16(2 * i, true));
  }
  function maps(group) {
    const about = dataOf(group), [rows, cols] = about.shape, side = about.side, wide = Math.ceil(cols / side);
    const boxes = [...group.querySelectorAll(".grid-box")], marks = boxes.map((box) => box.querySelector(".here"));
    const starts = new Map();
    about.starts.forEach(([row, col], robot) => {
      const key = row + "," + col;
      starts.set(key, [...(starts.get(key) || []), robot]);
    });
    const [east, north, yaw] = about.origin, measured = about.metres !== 1 || east !== 0 || north !== 0 || yaw !== 0;
    let codes = null, asked = false, last = null, cell = null;

    function metres(row, col) {
      const right = (col + 0.5) * about.metres, up = (rows - row - 0.5) * about.metres;
      const digits = about.metres < 1 ? 2 : about.metres < 10 ? 1 : 0;
      const x = east + Math.cos(yaw) * right - Math.sin(yaw) * up, y = north + Math.sin(yaw) * right + Math.cos(yaw) * up;
      return written(x, digits) + " m, " + written(y, digits) + " m";
    }
    hides.push(() => { for (const mark of marks) mark.hidden = true; });

    function value(layer, code) {
      if (code === 0) return "0" + (layer.unit ? " " + layer.unit : "");
      const part = code / about.steps, digits = layer.digits, least = 10 ** -digits;
      const scaled = part * layer.largest * (layer.unit === "%" ? 100 : 1), unit = layer.unit ? " " + layer.unit : "";
      if (scaled < least) return "< " + written(least, digits) + unit;
      if (layer.unit === "%" && code < about.steps && scaled > 100 - least) return "> " + written(100 - least, digits) + unit;
      return written(scaled, layer.unit === "%" && code === about.steps ? 0 : digits) + unit;
    }
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
        else about.layers.forEach((layer, i) => lines.push(["", layer.name, value(layer, found[i])]));
      } else lines.push(["", asked === "failed" ? "values need a newer browser" : "...", ""]);
      if (here) lines.push(["", here.length > 1 ? "start of robots" : "start of robot", here.join(", ")]);
      const title = side > 1
        ? "rows " + top + " to " + (Math.min(top + side, rows) - 1) + ", columns " + left + " to " + (Math.min(left + side, cols) - 1)
        : "row " + cell[0] + ", column " + cell[1];
      if (measured && side === 1) lines.push(["", "x, y", metres(cell[0], cell[1])]);
      const box = boxes[from].getBoundingClientRect();
      const x = mouse ? mouse[0] : box.left + ((cell[1] + 1) / cols) * box.width;
      show(boxes[from], x, mouse ? mouse[1] : box.top + (cell[0] / rows) * box.height, title, lines);
      if (!mouse) say(title, lines);
      if (!asked) {
        asked = true;
        Promise.all(about.layers.map((layer) => unpack(layer.codes)))
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
    function zoom(box) {
      const view = box.parentElement, bar = make("div", "zoom");
      let times = 1;
      for (const [sign, name, factor] of [["+", "Larger", 2], ["\u2212", "Smaller", 0.5]]) {
        const button = make("button", "", sign);
        button.type = "button";
        button.setAttribute("aria-label", name);
        button.addEventListener("click", () => {
          times = Math.min(Math.max(times * factor, 1), 32);
          view.classList.toggle("zoomed", times > 1);
          view.style.setProperty("--zoom", times);
        });
        bar.append(button);
      }
      view.before(bar);
    }
  }

  for (const figure of document.querySelectorAll(".chart")) chart(figure);
  for (const group of document.querySelectorAll(".cell-maps")) maps(group);
  for (const button of document.querySelectorAll(".copy")) {
    if (!navigator.clipboard) continue;
    button.hidden = false;
    button.addEventListener("click", async () => {
      const text = button.parentElement.querySelector("code").textContent;
      await navigator.clipboard.writeText(text).then(() => { button.textContent = "Copied"; }, () => { button.hidden = true; });
    });
  }
})();
