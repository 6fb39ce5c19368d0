// Radio buttons in a row, one of them chosen.
function choices(name, options, chosen, pick) {
  const field = make("fieldset", "choices");
  field.append(make("legend", "", name));
  options.forEach((text, number) => field.append(option("radio", name, text, number === chosen, () => pick(number))));
  return field;
}
function option(type, name, text, chosen, pick) {
  const label = make("label"), input = make("input");
  Object.assign(input, { type, name, checked: chosen });
  input.addEventListener("change", () => pick(input.checked));
  label.append(input, make("span", "", text));
  return label;
}
// The planned paths, shown or not; on a large map they would hide it.
function pathsOption(box, rows, cols) {
  const shown = Math.max(rows, cols) <= 128, turn = (on) => box.classList.toggle("bare", !on);
  turn(shown);
  return option("checkbox", "Paths", "Paths", shown, turn);
}
