// A run from its moves: the robots' cells and the covered cells at any step. This file does not use the page.
const BY_MOVE = (cols) => [0, -cols, cols, -1, 1];

// The cell of every step, from a first cell and the codes of the moves.
function cellsOf(codes, start, by) {
  const at = new Int32Array(codes.length + 1);
  at[0] = start;
  codes.forEach((code, step) => { at[step + 1] = at[step] + by[code]; });
  return at;
}

// moves: a Uint8Array a robot (codes of BY_MOVE, one a step); starts: its first cell; lost: the step of its loss, or -1.
function unfold(moves, starts, lost, time, rows, cols) {
  const by = BY_MOVE(cols), when = new Int32Array(rows * cols).fill(-1), who = new Int32Array(rows * cols).fill(-1);
  const robots = moves.map((codes, number) => {
    const at = cellsOf(codes, starts[number], by);
    const letters = ["M" + (starts[number] % cols) + " " + Math.floor(starts[number] / cols)], ends = [0];
    let last = 0, times = 0;
    const stroke = () => { if (times) letters.push((last < 3 ? "v" : "h") + (last % 2 ? -times : times)); };
    for (let step = 1; step <= codes.length; step++) {
      const code = codes[step - 1];
      if (code === 0) continue;
      if (code !== last) {
        stroke();
        times = 0;
        last = code;
        ends.push(step);
      }
      times += 1;
      ends[ends.length - 1] = step;
    }
    stroke();
    return { at, letters, ends, lost: lost[number] };
  });
  for (let step = 0; step <= time; step++) {
    robots.forEach((robot, number) => {
      if (step >= robot.at.length || when[robot.at[step]] >= 0) return;
      when[robot.at[step]] = step;
      who[robot.at[step]] = number;
    });
  }
  const [order, steps] = inOrder(when);
  return { robots, time, cols, when, who, order, steps };
}

// Cells in the order of their steps, without those of step -1, and the steps.
function inOrder(when) {
  const order = Int32Array.from(when.keys()).filter((cell) => when[cell] >= 0).sort((a, b) => when[a] - when[b]);
  return [order, order.map((cell) => when[cell])];
}

// The number of increasing values that are `most` or less.
function upTo(numbers, most) {
  let low = 0, high = numbers.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (numbers[middle] <= most) low = middle + 1; else high = middle;
  }
  return low;
}

const cellAt = (robot, step) => robot.at[Math.min(step, robot.at.length - 1)];
const isLost = (robot, step) => robot.lost >= 0 && robot.lost <= step;

// A robot's path so far as SVG path data.
function trail(robot, step, cols) {
  const strokes = upTo(robot.ends, step), known = robot.at[robot.ends[strokes - 1]], now = cellAt(robot, step);
  const down = Math.floor(now / cols) - Math.floor(known / cols), across = (now % cols) - (known % cols);
  const rest = down ? "v" + down : across ? "h" + across : strokes === 1 ? "h0" : "";
  return robot.letters.slice(0, strokes).join("") + rest;
}

// Seconds as text, in the format of planner/formatting.py.
function spoken(seconds) {
  const whole = Math.round(seconds), [large, unit, small, rest] = whole < 3600 ? [60, " min", " s", 1] : [3600, " h", " min", 60];
  if (seconds < 9.5) return Number(seconds.toPrecision(2)) + " s";
  if (whole < 60) return whole + " s";
  const more = Math.floor((whole % large) / rest);
  return Math.floor(whole / large) + unit + (more ? " " + more + small : "");
}
