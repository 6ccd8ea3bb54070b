// Reading what the page holds: a header, and lists of numbers in one deflated block of bytes. See arrays.py.

function textOf(id) {
  return document.getElementById(id).textContent;
}

async function inflated(base64) {
  const text = atob(base64.trim());
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < bytes.length; ++i) bytes[i] = text.charCodeAt(i);
  return inflatedStream(new Blob([bytes]).stream());
}

async function inflatedStream(stream) {
  const whole = new Response(stream.pipeThrough(new DecompressionStream("deflate")));
  return new Uint8Array(await whole.arrayBuffer());
}

// Floats, row by row, of a list that is stored column by column, each column of a chunk of rows in its own range.
function unquantised(list, bytes, view) {
  const { rows, columns, bits, chunk, at } = list;
  const chunks = Math.ceil(rows / chunk), wide = bits === 16;
  const values = new Float32Array(rows * columns);
  const start = at + 8 * chunks * columns, plane = rows;
  for (let column = 0; column < columns; ++column) {
    const high = start + column * (wide ? 2 : 1) * plane;
    for (let i = 0; i < rows; ++i) {
      const range = at + 8 * (Math.floor(i / chunk) * columns + column);
      const step = wide ? bytes[high + i] * 256 + bytes[high + plane + i] : bytes[high + i];
      values[i * columns + column] = view.getFloat32(range, true) + view.getFloat32(range + 4, true) * step;
    }
  }
  return values;
}

function numbersOf(list, bytes) {
  const view = new DataView(bytes.buffer);
  const size = list.rows * list.columns;
  if (list.kind === "quantised") return unquantised(list, bytes, view);
  if (list.kind === "uint8") return bytes.slice(list.at, list.at + size);
  const values = list.kind === "uint16" ? new Uint16Array(size) : new Float32Array(size);
  for (let i = 0; i < size; ++i)
    values[i] = list.kind === "uint16" ? view.getUint16(list.at + 2 * i, true) : view.getFloat32(list.at + 4 * i, true);
  return values;
}

// The header, with the lists by name as typed arrays.
async function readScene() {
  const scene = JSON.parse(textOf("header"));
  const bytes = await inflated(textOf("numbers"));
  scene.lists = {};
  for (const [name, list] of Object.entries(scene.layout)) scene.lists[name] = numbersOf(list, bytes);
  document.getElementById("numbers").remove();
  return scene;
}
