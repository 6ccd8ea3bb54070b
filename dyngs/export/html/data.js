// Reading what a page holds: a header, and lists of numbers in one deflated block of bytes. See scene_data.py.

const PLACES = ["header", "numbers"]; // of a page, by the ids of their elements

// The two texts of a page that `dyngs export --format html` wrote. It is not made a document: nothing in it can run.
function textsOf(page) {
  return PLACES.map((name) => {
    const mark = `id="${name}">`, start = page.indexOf(mark), end = page.indexOf("<\/script>", start);
    if (start < 0) throw new Error("it is no page that `dyngs export --format html` wrote");
    if (end < 0) throw new Error("it ends too early; copy it to the server again");
    return page.slice(start + mark.length, end);
  });
}

function bytesOf(base64) {
  const text = atob(base64.trim());
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < bytes.length; ++i) bytes[i] = text.charCodeAt(i);
  return bytes;
}

const SIZES = { uint8: 1, uint16: 2, float32: 4 };

function endOf({ kind, rows, columns, bits, chunk, at }) {
  if (kind !== "quantised") return at + SIZES[kind] * rows * columns;
  return at + columns * (8 * Math.ceil(rows / chunk) + (bits / 8) * rows);
}

// The lists of a layout, by name, as typed arrays; `blob` holds them deflated.
async function listsOf(layout, blob) {
  const bytes = new Uint8Array(Math.max(0, ...Object.values(layout).map(endOf)));
  const reader = blob.stream().pipeThrough(new DecompressionStream("deflate")).getReader();
  let size = 0;
  try {
    for (let piece = await reader.read(); !piece.done; piece = await reader.read()) {
      if (size + piece.value.length > bytes.length) throw new Error("longer than the header says");
      bytes.set(piece.value, size);
      size += piece.value.length;
    }
    if (size < bytes.length) throw new Error("shorter than the header says");
  } catch (error) {
    throw new Error(`its numbers are damaged (${error.message})`);
  }
  return Object.fromEntries(Object.entries(layout).map(([name, list]) => [name, numbersOf(list, bytes)]));
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

function headerOf(text) {
  try {
    const header = JSON.parse(text);
    if (header.layout && header.views.length) return header;
  } catch {} // said below
  throw new Error("its header is damaged");
}

// The scene of two texts: the header, with the lists by name.
async function sceneOf([header, numbers]) {
  const scene = headerOf(header);
  return { ...scene, lists: await listsOf(scene.layout, new Blob([bytesOf(numbers)])) };
}
