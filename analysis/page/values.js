// The box with the values at the pointer, the finger or the arrow keys; screen readers get the same text.
const tip = document.getElementById("tip"), live = document.getElementById("live");
// No-break spaces between numbers and units, as on the rest of the page.
const unbroken = (text) => String(text).replace(/(?<=\d) (?=[%\w\u00b1])|(?<=%) (?=\u00b1)|(?<=[\u00b1<>]) (?=\d)/g, "\u00a0");
const make = (name, look, text) => {
  const made = document.createElement(name);
  if (look) made.className = look;
  if (text !== undefined) made.textContent = unbroken(text);
  return made;
};
const written = (value, digits) =>
  value.toLocaleString("en-US", { minimumFractionDigits: digits, maximumFractionDigits: digits });
const dataOf = (box) => JSON.parse(box.querySelector('script[type="application/json"]').textContent);

let owner = null;
function show(whose, x, y, title, lines) {
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
addEventListener("pointerdown", (event) => { if (!event.target.closest(".grid-box")) hideAll(); });
