// The picture of the board: a canvas with one pixel for each cell, rings at the starts, and the colour scale below.
function makePicture(box, bar, palettes) {
  const canvas = box.querySelector(".cells"), context = canvas.getContext("2d"), shades = new Map();
  const rgb = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
  const obstacle = rgb(palettes.obstacle), unreachable = rgb(palettes.unreachable), fog = rgb(palettes.unknown);
  for (const layer of palettes.layers) shades.set(layer.name, layer.colours.map(rgb));
  let marks = [];

  // Position 0 .. 1 on the scale of a value, and the inverse.
  const place = (layer, part) => (layer.root ? Math.sqrt(part) : part);
  const value = (layer, at) => (layer.root ? at * at : at);

  // Upper end of the threat scale, float32 like cells: one of a few values, so that a stroke seldom changes all colours.
  function topOf(cells) {
    const largest = cells.reduce((most, p) => (p > most ? p : most), 0);
    return [0.05, 0.1, 0.25, 0.5, 1].map(Math.fround).find((top) => largest <= top);
  }
  function scale(layer, largest) {
    bar.style.background = "linear-gradient(90deg," + layer.colours.filter((_, i) => i % 8 === 0).join(",") + ")";
    bar.replaceChildren(...[0, 0.25, 0.5, 0.75, 1].map((at) => {
      const shown = value(layer, at) * largest, percent = layer.name !== "Losses";
      const word = make("span", "word x", percent ? String(+(100 * shown).toPrecision(2)) + " %" : String(+shown.toPrecision(2)));
      word.style.left = 100 * at + "%";
      return word;
    }));
  }

  // Draw the cells in a layer's colours; `packed`: its values in the last result, none for threats.
  function draw(board, layer, packed, steps) {
    const { rows, cols, cells } = board, top = packed ? steps : topOf(cells), colours = shades.get(layer.name), last = colours.length - 1;
    if (canvas.width !== cols || canvas.height !== rows) {
      canvas.width = cols;
      canvas.height = rows;
      box.style.aspectRatio = cols + "/" + rows;
      box.parentElement.style.setProperty("--ratio", cols / rows);
      box.parentElement.style.setProperty("--cols", cols);
    }
    const image = context.createImageData(cols, rows), bytes = image.data;
    for (let i = 0; i < cells.length; i++) {
      let colour = obstacle;
      if (!Number.isNaN(cells[i])) {
        const part = (packed ? packed.values[i] : cells[i]) / top;
        colour = part > 1 ? unreachable : colours[Math.min(last, Math.floor(place(layer, part) * colours.length))];
      }
      const clear = board.unknown[i] ? 0.45 : 1; // unknown cells are blended with fog
      for (let part = 0; part < 3; part++) bytes[4 * i + part] = clear * colour[part] + (1 - clear) * fog[part];
      bytes[4 * i + 3] = 255;
    }
    context.putImageData(image, 0, 0);
    scale(layer, packed ? packed.largest : top);
  }

  // A ring at each start, if they are few: many would hide the map.
  function rings(starts, rows, cols) {
    for (const mark of marks) mark.remove();
    const places = new Map(starts.map(([row, col]) => [row + "," + col, [row, col]]));
    marks = places.size > 64 ? [] : [...places.values()].map(([row, col]) => {
      const mark = make("i", "start");
      mark.style.left = (100 * (col + 0.5)) / cols + "%";
      mark.style.top = (100 * (row + 0.5)) / rows + "%";
      return mark;
    });
    box.append(...marks);
  }

  // The planned paths, one line for each robot; null: too long to draw.
  const drawn = box.querySelector(".paths");
  const given = (element, values) => { for (const name in values) element.setAttribute(name, values[name]); return element; };
  function paths(lines, thickness, rows, cols) {
    given(drawn, { viewBox: "0 0 " + cols + " " + rows, "stroke-width": thickness });
    drawn.replaceChildren(...(lines || []).map(([letters, colour, dashes, shift]) => given(
      document.createElementNS(drawn.namespaceURI, "path"),
      { d: letters, class: "r" + colour, "stroke-dasharray": dashes || "none", transform: "translate(" + shift + " " + shift + ")" },
    )));
  }
  return { draw, rings, paths };
}
