// What the page carries: facts as JSON, and the asset's bytes, compressed, in elements of base64.

import { FormatError } from "./asset.js";

export const facts = () => JSON.parse(document.getElementById("facts").textContent);

const DIGITS = new Int16Array(128).fill(-1);
[..."ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"].forEach((digit, n) => (DIGITS[digit.charCodeAt(0)] = n));

export function fromBase64(text) {
  if (Uint8Array.fromBase64) {
    try {
      return Uint8Array.fromBase64(text);
    } catch {
      throw new FormatError("the page's data are no base64; the page is damaged");
    }
  }
  return fromBase64Slow(text);
}

export function fromBase64Slow(text) {
  const end = text.endsWith("==") ? 2 : text.endsWith("=") ? 1 : 0, length = text.length - end, out = new Uint8Array(Math.floor((length * 3) / 4));
  let wrong = text.length % 4 ? 1 : 0;
  for (let from = 0, to = 0; from < length; from += 4) {
    let value = 0;
    for (let n = 0; n < 4; n++) {
      const code = from + n < length ? text.charCodeAt(from + n) : 65, digit = code < 128 ? DIGITS[code] : -1;
      wrong |= digit < 0;
      value = (value << 6) | (digit & 63);
    }
    out[to++] = value >> 16;
    if (to < out.length) out[to++] = value >> 8;
    if (to < out.length) out[to++] = value;
  }
  if (wrong) throw new FormatError("the page's data are no base64; the page is damaged");
  return out;
}

// The asset's bytes, exactly `size` of them. Raises FormatError. `progress` is told a share from 0 to 1, and awaited.
export async function inflated(size, progress) {
  if (!Number.isInteger(size) || size < 0 || size > 2 ** 31) throw new FormatError("the page states no sensible size of its data");
  const parts = [...document.querySelectorAll("script[data-part]")], out = new Uint8Array(size);
  let filled = 0;
  const stream = new DecompressionStream("deflate-raw"), writer = stream.writable.getWriter(), reader = stream.readable.getReader();
  const feeding = (async () => {
    for (let n = 0; n < parts.length; n++) {
      await writer.write(fromBase64(parts[n].textContent.trim()));
      parts[n].remove();
      await progress((n + 1) / parts.length);
    }
    await writer.close();
  })();
  feeding.catch((error) => writer.abort(error).catch(() => {})); // else the reader waits for more
  try {
    for (;;) {
      const { done, value } = await reader.read();
      if (done) break;
      if (filled + value.length > size) throw new FormatError("the page's data are longer than it states; the page is damaged");
      out.set(value, filled);
      filled += value.length;
    }
    await feeding;
  } catch (error) {
    writer.abort().catch(() => {});
    throw error instanceof FormatError ? error : new FormatError("the page's data can't be decompressed; the page is damaged");
  }
  if (filled !== size) throw new FormatError(`the page's data are ${filled} bytes, ${size} expected; the page is damaged`);
  return out;
}
