// Radio buttons in a row, one of them chosen.
function choices(name, options, chosen, pick) {
  const field = make("fieldset", "choices");
  field.append(make("legend", "", name));
  options.forEach((option, number) => {
    const label = make("label"), radio = make("input");
    radio.type = "radio";
    radio.name = name;
    radio.checked = number === chosen;
    radio.addEventListener("change", () => pick(number));
    label.append(radio, make("span", "", option));
    field.append(label);
  });
  return field;
}
