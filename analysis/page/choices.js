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
// The robots' paths hide the map, so they are drawn on demand.
function pathsOption(box) {
  const turn = (on) => box.classList.toggle("bare", !on);
  turn(false);
  return option("checkbox", "Paths", "Show paths", false, turn);
}
