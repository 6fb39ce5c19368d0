// Requests to the server of the page. They carry the token, which other pages do not have.
const KEPT = "mrac-jax studio";
if (location.hash.length > 1) {
  sessionStorage.setItem(KEPT, location.hash.slice(1)); // kept for a reload, removed from the address line
  history.replaceState(null, "", location.pathname);
}
addEventListener("hashchange", () => location.reload()); // the address has a new token
const token = sessionStorage.getItem(KEPT) || "";
async function call(path, body, signal) {
  const headers = { Authorization: "Bearer " + token };
  if (body) headers["Content-Type"] = "application/json";
  const response = await fetch(path, { method: body ? "POST" : "GET", headers, body: body && JSON.stringify(body), signal });
  if (response.ok) return response;
  const said = await response.json().catch(() => ({}));
  throw Error(response.status === 401 ? "this address has no token: open the address that the terminal shows" : said.error || response.statusText);
}

// The lines of the result of a board, as they arrive.
async function* answersTo(body, signal) {
  const response = await call("/answer", body, signal), reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    const lines = (rest + value).split("\n");
    rest = lines.pop();
    for (const line of lines) yield JSON.parse(line);
  }
}

function packCells(cells) {
  const bytes = new Uint8Array(cells.buffer, cells.byteOffset, cells.byteLength);
  let text = "";
  for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
}
function unpackBytes(text) {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
}
function unpackCells(text) {
  return new Float32Array(unpackBytes(text).buffer);
}
