// The studio: every change of the sketch starts a new request; only the newest one is displayed.
const at = (id) => document.getElementById(id);
const BRUSHES = ["Threat", "Obstacle", "Safe", "Unknown", "Known", "Start", "Move"], SIZES = ["1", "3", "7"], MOST_ROBOTS = 1024;
const numbers = ["risk_cap", "robot_value", "deadline"], summary = at("summary"), box = at("board"), here = box.querySelector(".here"), view = box.parentElement;

function problem(text) {
  at("problem").textContent = text;
  at("problem").hidden = !text;
}

async function start() {
  if (!window.DecompressionStream || !window.TextDecoderStream) throw Error("the studio needs a newer browser");
  const about = await (await call("/board")).json(), [rows, cols] = about.shape, { palettes } = about;
  const { cells, unknown, starts, robots } = about.board;
  const board = makeBoard(rows, cols, unpackCells(cells), starts, robots, unpackBytes(unknown));
  const picture = makePicture(box, at("bar"), palettes);
  let brush = 0, size = 1, shown = 0, cell = [0, 0], stroke = null, waiting = null;
  let answered = null, placed = board.starts || [], mouse = null, grabbed = null;
  at("name").textContent = about.name + ", " + rows + " x " + cols + " cells";
  document.title = about.name + " - mrac-jax studio";
  at("policy").value = about.board.policy;
  for (const key of numbers) at(key).value = about.board[key] ?? "";
  at("deadline-unit").textContent = about.paced ? "step, or a time: 45min" : "step";
  at("believed").value = +(100 * about.board.believed).toPrecision(6);
  at("sensor_range").value = about.board.sensor_range ?? "";
  at("save").textContent = "Save as " + about.out;

  // --- request and result ---
  const written_or_step = (text) => (/^\s*\d*\s*$/.test(text) ? +text || null : text.trim());
  const number = (key) => (at(key).value === "" || at(key).disabled ? null : +at(key).value);
  const body = () => ({
    cells: packCells(board.cells), starts: board.starts, robots: board.robots, policy: at("policy").value,
    risk_cap: number("risk_cap"), robot_value: number("robot_value"), deadline: written_or_step(at("deadline").value),
    unknown: packCells(board.unknown), believed: number("believed") / 100, sensor_range: number("sensor_range"),
  });
  async function ask() {
    if (waiting) waiting.abort();
    const wrong = [...document.querySelectorAll("#team input:enabled")].find((field) => !field.checkValidity());
    problem(wrong ? wrong.parentElement.firstChild.textContent + ": " + wrong.validationMessage : "");
    if (wrong) return;
    const mine = (waiting = new AbortController()), clock = performance.now(), times = {};
    summary.dataset.stage = "asked";
    at("saved").textContent = "";
    document.querySelector(".command").hidden = true;
    try {
      for await (const line of answersTo(body(), mine.signal)) {
        if (mine !== waiting || line.superseded) return;
        if (line.error) throw Error(line.error);
        const layers = await Promise.all(line.layers.map(async (layer) => ({ ...layer, values: await unpack(layer.codes) })));
        if (mine !== waiting) return;
        times[line.stage] ??= (performance.now() - clock) / 1000;
        take({ ...line, layers, times });
      }
    } catch (error) {
      if (mine !== waiting || error.name === "AbortError") return;
      summary.dataset.stage = "failed";
      problem(error instanceof TypeError ? "The studio does not respond: is it still running in the terminal?" : error.message);
    }
  }
  function take(line) {
    answered = line;
    placed = line.starts;
    if ("paths" in line) picture.paths(line.paths, line.thickness, rows, cols);
    problem("");
    summary.textContent = unbroken(line.summary);
    summary.dataset.stage = line.stage;
    summary.dataset.times = JSON.stringify(line.times);
    at("figures").replaceChildren(...line.figures.map(([value, name, note]) => {
      const tile = make("li");
      tile.append(make("strong", "", value), make("span", "", name), make("small", "", note));
      return tile;
    }));
    at("notes").replaceChildren(...line.notes.map((note) => make("li", "", note)));
    const { open, sure } = line.times, first = open === undefined ? "" : "Open loop, exact, after " + written(open, 2) + " s. ";
    at("status").textContent = first + (sure === undefined ? "Simulating the closed loop ..."
      : "± 0.5 points after " + written(sure, 2) + " s.");
    show_all();
    if (owner === box && !tip.hidden && !stroke) tell();
    if (line.stage === "done") at("live").textContent = line.summary;
  }
  function show_all() {
    const packed = answered && shown > 0 ? answered.layers[shown - 1] : null;
    picture.draw(board, palettes.layers[packed ? shown : 0], packed, answered && answered.steps);
    picture.rings(board.starts || placed, rows, cols);
    at("undo").disabled = !board.canGoBack;
    at("redo").disabled = !board.canGoForth;
    at("robots").value = board.robots;
    at("robots-unit").textContent = board.starts ? "starts painted" : "by rule, upper-left";
  }
  function changed() {
    show_all();
    ask();
  }

  // --- painting ---
  function dab(from, to) {
    const chance = Math.min(Math.max(+at("chance").value / 100, 1e-4), 0.999);
    const robot = BRUSHES[brush] === "Start";
    const done = robot ? board.toggleStart(...to, placed, MOST_ROBOTS) : board.paint(BRUSHES[brush], chance, size, from, to);
    problem(robot && !done ? "Robots start on free cells, 1 to " + MOST_ROBOTS + " of them." : "");
    if (done) show_all();
    return done;
  }
  function point(row, col, place) {
    cell = [Math.min(Math.max(row, 0), rows - 1), Math.min(Math.max(col, 0), cols - 1)];
    mouse = place;
    here.hidden = false;
    const share = (n, of) => (100 * n) / of + "%";
    Object.assign(here.style, { left: share(cell[1], cols), top: share(cell[0], rows), width: share(1, cols), height: share(1, rows) });
    const said = tell();
    if (place) return;
    here.scrollIntoView({ block: "nearest", inline: "nearest" });
    say(...said);
  }
  // Facts of the cell under the pointer.
  function tell() {
    const index = cell[0] * cols + cell[1], threat = board.cells[index];
    const lines = [["", Number.isNaN(threat) ? "obstacle" : "threat", Number.isNaN(threat) ? "" : written(100 * threat, 2) + " %"]];
    if (board.unknown[index]) lines.push(["", "unknown to robots", "prior threat " + written(+at("believed").value, 2) + " %"]);
    for (const layer of answered ? answered.layers : []) {
      if (layer.values[index] <= answered.steps) lines.push(["", layer.name, valueOf(layer, layer.values[index], answered.steps)]);
    }
    const robots = (board.starts || placed).flatMap(([r, c], robot) => (r === cell[0] && c === cell[1] ? [robot] : []));
    if (robots.length) lines.push(["", "start of", robots.join(", ")]);
    const title = "row " + cell[0] + ", column " + cell[1], area = here.getBoundingClientRect();
    if (!stroke) show(box, mouse ? mouse[0] : area.right, mouse ? mouse[1] : area.top, title, lines);
    return [title, lines];
  }
  function under(event) {
    const area = box.getBoundingClientRect();
    return [Math.floor(((event.clientY - area.top) / area.height) * rows), Math.floor(((event.clientX - area.left) / area.width) * cols)];
  }
  function finish() {
    if (!stroke) return;
    if (stroke.done) changed(); else { board.drop(); show_all(); }
    stroke = null;
  }
  hides.push(() => { here.hidden = true; });
  box.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || stroke) return;
    point(...under(event), [event.clientX, event.clientY]);
    if (BRUSHES[brush] === "Move") { // touch scrolls natively
      if (event.pointerType === "mouse") grabbed = [event.clientX + view.scrollLeft, event.clientY + view.scrollTop];
      return;
    }
    box.setPointerCapture(event.pointerId);
    board.keep();
    stroke = { last: cell, done: false };
    stroke.done = dab(cell, cell);
    tip.hidden = true;
  });
  addEventListener("pointermove", (event) => {
    if (grabbed) view.scrollTo(grabbed[0] - event.clientX, grabbed[1] - event.clientY);
  });
  addEventListener("pointerup", () => { grabbed = null; });
  box.addEventListener("pointermove", (event) => {
    point(...under(event), [event.clientX, event.clientY]);
    if (!stroke || BRUSHES[brush] === "Start" || String(stroke.last) === String(cell)) return;
    stroke.done = dab(stroke.last, cell) || stroke.done;
    stroke.last = cell;
  });
  for (const name of ["pointerup", "pointercancel"]) box.addEventListener(name, finish);
  box.addEventListener("pointerleave", () => { if (!stroke) hideAll(); });
  box.addEventListener("blur", () => { if (owner === box) hideAll(); });
  function once() {
    if (BRUSHES[brush] === "Move") return;
    board.keep();
    if (dab(cell, cell)) changed(); else board.drop();
  }
  box.addEventListener("keydown", (event) => {
    const steps = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] }[event.key];
    if (steps) {
      point(cell[0] + steps[0], cell[1] + steps[1]);
      if (event.shiftKey && BRUSHES[brush] !== "Start") once();
    } else if (event.key === " " || event.key === "Enter") {
      once();
      point(...cell);
    } else if ("1234567".includes(event.key)) at("brushes").querySelectorAll("input")[event.key - 1].click();
    else return;
    event.preventDefault();
  });
  box.addEventListener("focus", () => { if (box.matches(":focus-visible")) point(...cell); });

  // --- the controls ---
  at("brushes").append(choices("Brush", BRUSHES, brush, (n) => {
    brush = n;
    box.classList.toggle("move", BRUSHES[n] === "Move");
  }));
  at("sizes").append(choices("Size", SIZES, 0, (n) => { size = +SIZES[n]; }));
  at("layers").append(choices("Layer", palettes.layers.map((layer) => layer.name), shown, (n) => { shown = n; show_all(); }));
  at("layers").firstChild.append(pathsOption(box));
  if (Math.max(rows, cols) > 40) zoom(box);
  const step = (way) => () => { board[way](); changed(); };
  at("undo").addEventListener("click", step("back"));
  at("redo").addEventListener("click", step("forth"));
  at("again").addEventListener("click", () => {
    board.keep();
    board.set(unpackCells(about.first.cells), unpackBytes(about.first.unknown), about.first.starts, about.first.robots);
    changed();
  });
  addEventListener("keydown", (event) => {
    if (!(event.ctrlKey || event.metaKey) || event.target.matches("input[type=number], input[type=text]")) return;
    const key = event.key.toLowerCase(), forth = key === "y" || (key === "z" && event.shiftKey);
    if (key !== "z" && key !== "y") return;
    event.preventDefault();
    step(forth ? "forth" : "back")();
  });
  function limit() {
    const limited = at("policy").selectedOptions[0].hasAttribute("data-limited");
    for (const key of ["risk_cap", "robot_value"]) at(key).disabled = !limited;
  }
  limit();
  at("policy").addEventListener("change", limit);
  at("team").addEventListener("change", (event) => {
    if (event.target.id === "robots") {
      board.keep();
      board.place(Math.min(Math.max(Math.round(+event.target.value) || 1, 1), MOST_ROBOTS));
    }
    changed();
  });
  const command = document.querySelector(".command"), copy = command.querySelector(".copy");
  at("save").addEventListener("click", async () => {
    try {
      const rollouts = answered && ["sure", "done"].includes(summary.dataset.stage) ? answered.rollouts : null;
      const said = await (await call("/save", { ...body(), rollouts })).json();
      at("saved").textContent = "Saved " + said.written.join(" and ") + ". To repeat the result:";
      at("command").textContent = said.command;
      command.hidden = false;
    } catch (error) { problem(error.message); }
  });
  copy.hidden = !navigator.clipboard;
  copy.addEventListener("click", () => navigator.clipboard.writeText(at("command").textContent).then(() => { copy.textContent = "Copied"; }));
  changed();
}
start().catch((error) => problem(error.message));
