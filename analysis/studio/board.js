// The board: cells (probability, NaN = obstacle), cells unknown to robots, starts (null: placed by the rule), and the
// history for undo.
const MOST_KEPT = 2e7; // limit of cells in the history
function makeBoard(rows, cols, cells, starts, robots, unknown = new Uint8Array(cells.length)) {
  const past = [], future = [], most = Math.max(10, Math.min(200, Math.floor(MOST_KEPT / (rows * cols))));
  let now = { cells, unknown, starts, robots };
  const inside = (row, col) => row >= 0 && row < rows && col >= 0 && col < cols;
  const isAt = (row, col) => ([r, c]) => r === row && c === col;

  // Apply the square brush to a cell; true if anything changed.
  function dab(brush, chance, size, row, col) {
    const reach = (size - 1) / 2;
    let changed = false;
    for (let r = row - reach; r <= row + reach; r++) {
      for (let c = col - reach; c <= col + reach; c++) {
        if (!inside(r, c)) continue;
        const at = r * cols + c, old = now.cells[at];
        if (brush === "Unknown" || brush === "Known") {
          const hides = +(brush === "Unknown");
          changed = changed || now.unknown[at] !== hides;
          now.unknown[at] = hides;
          continue;
        }
        const value = brush === "Obstacle" ? NaN : brush === "Safe" ? 0 : Number.isNaN(old) ? NaN : Math.fround(chance);
        if (Object.is(old, value)) continue;
        now.cells[at] = value;
        changed = true;
      }
    }
    if (brush === "Obstacle" && now.starts) {
      const left = now.starts.filter(([r, c]) => !Number.isNaN(now.cells[r * cols + c]));
      now.starts = left.length ? left : null;
    }
    return changed;
  }
  return {
    rows, cols,
    get cells() { return now.cells; },
    get unknown() { return now.unknown; },
    get starts() { return now.starts; },
    get robots() { return now.robots; },
    // Save the state before a change, for undo.
    keep() {
      past.push(now);
      if (past.length > most) past.shift();
      future.length = 0;
      now = { cells: now.cells.slice(), unknown: now.unknown.slice(), starts: now.starts && now.starts.slice(), robots: now.robots };
    },
    // Undo the last `keep`: nothing changed.
    drop() { now = past.pop(); },
    // Paint the cells on the line between two cells, inclusive.
    paint(brush, chance, size, from, to) {
      const steps = Math.max(Math.abs(to[0] - from[0]), Math.abs(to[1] - from[1]));
      let changed = false;
      for (let i = 0; i <= steps; i++) {
        const part = steps ? i / steps : 0;
        const row = Math.round(from[0] + part * (to[0] - from[0])), col = Math.round(from[1] + part * (to[1] - from[1]));
        changed = dab(brush, chance, size, row, col) || changed;
      }
      return changed;
    },
    // Add a robot at a free cell, or remove the one there; `placed`: the present starts.
    toggleStart(row, col, placed, mostRobots) {
      const starts = (now.starts || placed).slice(), old = starts.findIndex(isAt(row, col));
      if (old >= 0) starts.splice(old, 1);
      else if (Number.isNaN(now.cells[row * cols + col]) || starts.length >= mostRobots) return false;
      else starts.push([row, col]);
      if (!starts.length) return false;
      now.starts = starts;
      now.robots = starts.length;
      return true;
    },
    // Replace the whole state.
    set(cells, unknown, starts, robots) { now = { cells: cells.slice(), unknown: unknown.slice(), starts, robots }; },
    // A number of robots, placed by the rule.
    place(robots) { now.starts = null; now.robots = robots; },
    back() { if (past.length) { future.push(now); now = past.pop(); } },
    forth() { if (future.length) { past.push(now); now = future.pop(); } },
    get canGoBack() { return past.length > 0; },
    get canGoForth() { return future.length > 0; },
  };
}
