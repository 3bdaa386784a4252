// Readers of node's packages for benchmarks/format_readers.py: node format_readers.mjs READER FILE FOLDER. Arrays go to FOLDER, with about.json; the last line
// of the output names the reader.
import { readFileSync, writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";

const [reader, file, folder] = process.argv.slice(2);
const require = createRequire(import.meta.url);
const version = (name) => JSON.parse(readFileSync(new URL(`./node_modules/${name}/package.json`, import.meta.url))).version;
const about = {};
const TYPES = { Float32Array: "<f4", Float64Array: "<f8", Uint8Array: "u1", Uint8ClampedArray: "u1", Uint16Array: "<u2" };

function keep(name, array, width) {
  writeFileSync(join(folder, name), new Uint8Array(array.buffer, array.byteOffset, array.byteLength));
  about[name] = { type: TYPES[array.constructor.name], shape: [array.length / width, width] };
}

function whole(path) {
  const data = readFileSync(path);
  return data.buffer.slice(data.byteOffset, data.byteOffset + data.byteLength);
}

const READERS = {
  async las() {
    const { Las } = require("copc");
    const data = new Uint8Array(whole(file)), header = Las.Header.parse(data), getter = async (begin, end) => data.slice(begin, end);
    const listed = await Las.Vlr.walk(getter, header), extra = Las.Vlr.find(listed, "LASF_Spec", 4);
    const dimensions = Las.ExtraBytes.parse(await Las.Vlr.fetch(getter, extra));
    const size = header.pointCount * header.pointDataRecordLength;
    const points = file.endsWith(".laz") ? await Las.PointData.decompressFile(data) : data.slice(header.pointDataOffset, header.pointDataOffset + size);
    const view = Las.View.create(points, header, dimensions);
    for (const [name, columns] of [["places", "XYZ"], ["colours", ["Red", "Green", "Blue"]], ["normals", ["NormalX", "NormalY", "NormalZ"]]]) {
      const out = new Float64Array(3 * view.pointCount), columnsOf = [...columns].map((each) => view.getter(each));
      for (let n = 0; n < view.pointCount; n++) columnsOf.forEach((get, k) => { out[3 * n + k] = get(n); });
      keep(name, out, 3);
    }
    return `copc.js ${version("copc")} (laz-perf)`;
  },

  async splats() {
    globalThis.self ??= globalThis;
    let splats = null;
    if (file.endsWith(".glb")) {
      const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
      const { GLTFGaussianSplatLoaderExtension } = await import("three/addons/loaders/GLTFGaussianSplatLoaderExtension.js");
      const loader = new GLTFLoader().register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
      const { scene } = await new Promise((done, failed) => loader.parse(whole(file), "", done, failed));
      scene.traverse((each) => { splats = each.isGaussianSplat ? each.splatGeometry : splats; });
    } else {
      const name = file.endsWith(".spz") ? "SPZLoader" : "GaussianSplatPLYLoader";
      splats = await new (await import(`three/addons/loaders/${name}.js`))[name]().parse(whole(file));
    }
    const { position, covariance, color } = splats.attributes;
    keep("places", position.array, 3);
    keep("covariances", covariance.array, 6);
    keep("colours", color.array, 4);
    return `three.js ${version("three")}`;
  },

  async cameras() {
    const { Matrix4, PerspectiveCamera, Vector3 } = await import("three");
    const frames = JSON.parse(readFileSync(file)).frames, places = [], forward = [];
    for (const frame of frames) {
      const camera = new PerspectiveCamera(), direction = new Vector3();
      new Matrix4().set(...frame.transform_matrix.flat()).decompose(camera.position, camera.quaternion, camera.scale);
      camera.updateMatrixWorld();
      places.push(...camera.position.toArray());
      forward.push(...camera.getWorldDirection(direction).toArray());
    }
    keep("places", new Float64Array(places), 3);
    keep("forward", new Float64Array(forward), 3);
    return `three.js ${version("three")}`;
  },

  async validate() {
    const { issues } = await require("gltf-validator").validateBytes(new Uint8Array(whole(file)));
    const { numErrors, numWarnings, numInfos, messages } = issues;
    const codes = [...new Set(messages.map((each) => each.code))];
    writeFileSync(join(folder, "report.json"), JSON.stringify({ errors: numErrors, warnings: numWarnings, infos: numInfos, codes }));
    return `gltf-validator ${version("gltf-validator")}`;
  },
};

const name = await READERS[reader]();
writeFileSync(join(folder, "about.json"), JSON.stringify(about));
console.log(name);
process.exit(0);
