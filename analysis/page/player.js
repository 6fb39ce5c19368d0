// The first map: a switch of layers, and the player of runs.
// The images are those of the section cell by cell, so that the page holds them once. Returns a function that shows the
// threats of a step, if threats are shown.
function layers(group) {
  const head = group.querySelector(".map"), box = head.querySelector(".grid-box"), source = document.getElementById(dataOf(group).from);
  const paths = box.querySelector(".paths") ? [pathsOption(box)] : [];
  if (!source) {
    head.querySelector(".about").after(...paths);
    return () => {};
  }
  const maps = [...source.querySelectorAll(".map")], titles = maps.map((map) => map.dataset.short);
  const since = maps.map((map) => ("since" in map.dataset ? +map.dataset.since : Infinity));
  let shown = 0;
  const field = choices("Layer", titles, 0, (number) => {
    shown = number;
    const picture = head.querySelector(".cells"), other = maps[number].querySelector(".cells");
    picture.src = other.src;
    picture.alt = other.alt;
    head.querySelector(".about").textContent = maps[number].querySelector(".about").textContent;
    head.querySelector(".bar-box").replaceWith(maps[number].querySelector(".bar-box").cloneNode(true));
  });
  field.append(...paths);
  head.querySelector(".about").after(field);
  return (step) => {
    const now = since.findLastIndex((begin) => begin <= step);
    if (since[shown] < Infinity && now !== shown) field.querySelectorAll("input[type=radio]")[now].click();
  };
}

// A veil over the cells of a map, each lifted at its step.
function curtain(box, look, colour, rows, cols) {
  const canvas = make("canvas", "veil " + look), context = canvas.getContext("2d"), at = (cell) => [cell % cols, Math.floor(cell / cols), 1, 1];
  let order = [], steps = [], lifted = 0;
  canvas.width = cols;
  canvas.height = rows;
  box.querySelector(".cells").after(canvas);
  return {
    hang(cells, when) {
      [order, steps, lifted] = [cells, when, 0];
      context.fillStyle = colour;
      context.fillRect(0, 0, cols, rows);
    },
    lift(step) {
      const most = upTo(steps, step);
      for (; lifted < most; lifted++) context.clearRect(...at(order[lifted]));
      for (; lifted > most; lifted--) context.fillRect(...at(order[lifted - 1]));
      return most;
    },
    open() {
      [order, steps] = [[], []];
      context.clearRect(0, 0, cols, rows);
    },
  };
}

function player(group, showThreats) {
  const box = group.querySelector(".grid-box"), script = group.querySelector(".runs");
  if (!script || !window.DecompressionStream) return;
  const about = JSON.parse(script.textContent), [rows, cols] = about.shape, known = new Map();
  const lines = [...box.querySelectorAll(".paths path")];
  const told = (step) => written(step, 0) + (about.seconds ? " (" + spoken(step * about.seconds) + ")" : "");
  const fog = curtain(box, "fog", "#4a4560", rows, cols), veil = curtain(box, "", "#78818f", rows, cols);
  const marks = about.shifts.map((shift, number) => {
    const mark = make("i", "robot r" + (number % 8), about.shifts.length > 64 ? "" : number);
    box.append(mark);
    return mark;
  });

  const threats = Array.from({ length: Math.max(...about.runs.map((one) => (one.threats ? one.threats.starts.length : 0))) }, () => {
    const mark = make("i", "moving");
    mark.title = "moving threat";
    box.append(mark);
    return mark;
  });

  // --- the controls ---
  const panel = make("div", "player"), bar = make("div", "controls"), track = make("div", "track-box");
  const press = (look, name, text, act) => {
    const button = make("button", look, text);
    button.type = "button";
    if (name) button.setAttribute("aria-label", name);
    button.addEventListener("click", act);
    return button;
  };
  const play = press("play", "", "Play", () => (playing ? pause() : start()));
  const slider = make("input"), said = make("output"), deaths = make("div", "deaths");
  slider.type = "range";
  slider.min = 0;
  slider.setAttribute("aria-label", "Step");
  slider.addEventListener("input", () => { pause(); draw(+slider.value); });
  const one = (by) => () => { pause(); draw(step + by); };
  track.append(deaths, slider);
  bar.append(play, press("", "One step back", "\u2039", one(-1)), track, press("", "One step on", "\u203a", one(1)));
  panel.append(choices("Run", about.runs.map((run) => run.name), 0, choose), bar, said);
  group.querySelector(".cell-maps").after(panel);

  // --- a run ---
  let run = null, replay = null, step = 0, playing = 0, wanted = 0;
  async function load(number) {
    if (!known.has(number)) {
      const packed = about.runs[number], moves = await Promise.all(packed.moves.map(inflate));
      const found = unfold(moves.map((buffer) => new Uint8Array(buffer)), packed.starts, packed.lost, packed.time, rows, cols);
      const moving = packed.threats || { starts: [], moves: [] }, ways = await Promise.all(moving.moves.map(inflate));
      found.threats = ways.map((way, number) => ({ at: cellsOf(new Uint8Array(way), moving.starts[number], BY_MOVE(cols)) }));
      if (packed.seen) found.seen = new Int32Array(await inflate(packed.seen));
      known.set(number, found);
    }
    return known.get(number);
  }
  async function choose(number) {
    pause();
    const mine = ++wanted, found = await load(number);
    if (mine !== wanted) return; // another run was selected meanwhile
    replay = found;
    run = about.runs[number];
    veil.hang(replay.order, replay.steps);
    fog.open();
    if (replay.seen) fog.hang(...inOrder(replay.seen));
    slider.max = run.time;
    deaths.replaceChildren(...run.lost.filter((at) => at >= 0).map((at) => {
      const mark = make("i");
      mark.style.left = (100 * at) / Math.max(run.time, 1) + "%";
      return mark;
    }));
    draw(run.time);
  }
  function put(mark, cell, shift) {
    mark.style.left = (100 * ((cell % cols) + shift)) / cols + "%";
    mark.style.top = (100 * (Math.floor(cell / cols) + shift)) / rows + "%";
  }
  function draw(to) {
    if (!replay) return;
    step = Math.min(Math.max(Math.floor(to), 0), run.time);
    const covered = veil.lift(step), seen = replay.seen ? " " + written(fog.lift(step), 0) + " cells seen." : "";
    replay.robots.forEach((robot, number) => {
      const cell = cellAt(robot, step), mark = marks[number], shift = about.shifts[number] + 0.5;
      put(mark, cell, shift);
      mark.classList.toggle("lost", isLost(robot, step));
      if (lines[number]) lines[number].setAttribute("d", trail(robot, step, cols));
    });
    threats.forEach((mark, number) => {
      mark.hidden = number >= replay.threats.length;
      if (!mark.hidden) put(mark, cellAt(replay.threats[number], step), 0.5);
    });
    const gone = run.lost.map((at, robot) => [at, robot]).filter(([at]) => at >= 0 && at <= step).sort((a, b) => a[0] - b[0]);
    const part = written((100 * covered) / about.accessible, 1), left = marks.length - gone.length;
    const names = gone.slice(-6).map(([at, robot]) => "robot " + robot + " at step " + told(at));
    const lost = names.length ? " Lost: " + (gone.length > 6 ? "... " : "") + names.join(", ") + "." : "";
    slider.value = step;
    showThreats(step);
    slider.setAttribute("aria-valuetext", "step " + told(step) + ", " + part + " % covered, " + left + " robots left");
    said.textContent = unbroken("Step " + told(step) + " of " + told(run.time) + ": " + written(covered, 0) + " of "
      + written(about.accessible, 0) + " cells (" + part + " %) covered, " + left + " of " + marks.length + " robots left." + seen + lost);
  }
  tellers.set(box, (row, col) => {
    const cell = row * cols + col;
    if (!replay) return [];
    const when = replay.when[cell], seen = replay.seen ? replay.seen[cell] : null;
    const known = seen === null ? [] : [["", "first seen", seen < 0 ? "never" : "step " + told(seen), ""]];
    return [...known, ["", "in this run", when < 0 ? "not covered" : "step " + told(when), when < 0 ? "" : "robot " + replay.who[cell]]];
  });

  // --- playing: a run takes some 20 seconds, a short one less ---
  function start() {
    if (!replay) return;
    if (step >= run.time) draw(0);
    const speed = Math.max(8, run.time / 20), from = step;
    let begun = 0;
    play.textContent = "Pause";
    const frame = (now) => {
      begun = begun || now;
      draw(from + ((now - begun) / 1000) * speed);
      if (step >= run.time) pause(); else playing = requestAnimationFrame(frame);
    };
    playing = requestAnimationFrame(frame);
  }
  function pause() {
    cancelAnimationFrame(playing);
    playing = 0;
    play.textContent = "Play";
  }
  choose(0);
}
