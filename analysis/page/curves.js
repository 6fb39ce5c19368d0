// Curves: the values at the nearest x, and series that can be hidden.
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
    const at = about.xWords[x] ?? written(x, about.xDigits), box = plot.getBoundingClientRect();
    const title = about.xName.split("(")[0].trim() + " " + at;
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
