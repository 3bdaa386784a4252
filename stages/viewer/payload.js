// What the page carries: facts as JSON, and the asset's bytes, compressed, in elements of base64.

import { FormatError } from "./asset.js";

export const element = (id) => document.getElementById(id);
export const facts = () => JSON.parse(element("facts").textContent);

export function fromBase64(text) {
  try {
    if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
    const raw = atob(text), out = new Uint8Array(raw.length);
    for (let n = 0; n < raw.length; n++) out[n] = raw.charCodeAt(n);
    return out;
  } catch {
    throw new FormatError("the page's data are no base64; the page is damaged");
  }
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
