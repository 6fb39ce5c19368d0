// Start of the interactive elements; the page is readable without them.
for (const group of document.querySelectorAll(".cell-maps")) maps(group);
for (const group of document.querySelectorAll(".plan-map")) {
  player(group, layers(group));
}
for (const box of document.querySelectorAll(".scroll")) { // marks tables that are cut at the edge
  new ResizeObserver(() => box.classList.toggle("cut", box.scrollWidth > box.clientWidth + 1)).observe(box);
}
for (const button of document.querySelectorAll(".copy")) {
  if (!navigator.clipboard) continue;
  button.hidden = false;
  button.addEventListener("click", async () => {
    const text = button.parentElement.querySelector("code").textContent;
    await navigator.clipboard.writeText(text).then(() => { button.textContent = "Copied"; }, () => { button.hidden = true; });
  });
}
