// Reads msgpack as the server writes it: nil, booleans, numbers, strings, bytes, arrays and maps.

const text = new TextDecoder();

export function decode(buffer) {
  const view = new DataView(buffer);
  let at = 0;

  function take(count) {
    at += count;
    return at - count;
  }
  function string(length) {
    return text.decode(new Uint8Array(buffer, take(length), length));
  }
  function bytes(length) {
    const begin = take(length);
    return buffer.slice(begin, begin + length); // a copy: a Float64Array wants it aligned
  }
  function array(length) {
    return Array.from({ length }, value);
  }
  function map(length) {
    const found = {};
    for (let i = 0; i < length; i += 1) {
      const key = value();
      found[key] = value();
    }
    return found;
  }
  function value() {
    const head = view.getUint8(take(1));
    if (head < 0x80) return head;
    if (head < 0x90) return map(head & 0x0f);
    if (head < 0xa0) return array(head & 0x0f);
    if (head < 0xc0) return string(head & 0x1f);
    if (head >= 0xe0) return head - 0x100;
    switch (head) {
      case 0xc0: return null;
      case 0xc2: return false;
      case 0xc3: return true;
      case 0xc4: return bytes(view.getUint8(take(1)));
      case 0xc5: return bytes(view.getUint16(take(2)));
      case 0xc6: return bytes(view.getUint32(take(4)));
      case 0xca: return view.getFloat32(take(4));
      case 0xcb: return view.getFloat64(take(8));
      case 0xcc: return view.getUint8(take(1));
      case 0xcd: return view.getUint16(take(2));
      case 0xce: return view.getUint32(take(4));
      case 0xcf: return Number(view.getBigUint64(take(8)));
      case 0xd0: return view.getInt8(take(1));
      case 0xd1: return view.getInt16(take(2));
      case 0xd2: return view.getInt32(take(4));
      case 0xd3: return Number(view.getBigInt64(take(8)));
      case 0xd9: return string(view.getUint8(take(1)));
      case 0xda: return string(view.getUint16(take(2)));
      case 0xdb: return string(view.getUint32(take(4)));
      case 0xdc: return array(view.getUint16(take(2)));
      case 0xdd: return array(view.getUint32(take(4)));
      case 0xde: return map(view.getUint16(take(2)));
      case 0xdf: return map(view.getUint32(take(4)));
      default: throw new Error(`msgpack type 0x${head.toString(16)}`);
    }
  }
  return value();
}
