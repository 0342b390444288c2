// Frames of the server: a head in JSON and the numbers behind it. The layout is that of `protocol.md`.

const HEAD_LIMIT = 1 << 24;

/** A frame taken apart: its head, and all its numbers as one `Float32Array` on the bytes received. */
export function decodeFrame(buffer) {
  if (buffer.byteLength < 4) throw new Error(`frame of ${buffer.byteLength} bytes, expected at least 4`);
  const length = new DataView(buffer).getUint32(0, true);
  if (length > HEAD_LIMIT || 4 + length > buffer.byteLength) {
    throw new Error(`head of ${length} bytes in a frame of ${buffer.byteLength}`);
  }
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const start = Math.ceil((4 + length) / 4) * 4;
  const rest = Math.max(buffer.byteLength - start, 0);
  const numbers = rest >= 4 ? new Float32Array(buffer, start, Math.floor(rest / 4)) : new Float32Array(0);
  return { head, numbers };
}

const ROWS_BEFORE_QUANTITIES = { estimate: 2, truth: 1 };
const ROWS_PER_QUANTITY = { estimate: 3, truth: 1 };
const ROWS_OF_SINGLE = { samples: 2, parameters: 6, beats: 4 };

function rowCount(part) {
  if (part.part in ROWS_OF_SINGLE) return ROWS_OF_SINGLE[part.part];
  if (!(part.part in ROWS_PER_QUANTITY)) throw new Error(`part "${part.part}" is not known`);
  return ROWS_BEFORE_QUANTITIES[part.part] + ROWS_PER_QUANTITY[part.part] * part.quantities.length;
}

/** The parts of a bed frame, each with its rows of `n` numbers in the order of the protocol. */
export function partsOf(head, numbers) {
  let offset = 0;
  return (head.parts ?? []).map((part) => {
    const rows = [];
    for (let row = rowCount(part); row > 0; row -= 1) {
      if (offset + part.n > numbers.length) {
        throw new Error(`part "${part.part}" ends at number ${offset + part.n}, the frame has ${numbers.length}`);
      }
      rows.push(numbers.subarray(offset, offset + part.n));
      offset += part.n;
    }
    return { ...part, rows };
  });
}
