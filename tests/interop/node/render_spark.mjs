// Renders a Gaussian .ply with Spark (three.js) in a headless Chromium on SwiftShader; prints a JSON answer.
// usage: node render_spark.mjs job.json; job = {ply, width, height, fov_deg (vertical), near, poses, out, chromium},
// poses: world_camera matrices (row-major 4x4, optical frame: x right, y down, z forward), world as in the file.
// View i is written as out/view_i.rgba: height x width x 4 bytes, top row first.
import { spawn } from "node:child_process";
import { createReadStream, mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { createServer } from "node:http";
import { tmpdir } from "node:os";
import { dirname, join, normalize } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const job = JSON.parse(readFileSync(process.argv[2], "utf8"));
const LIMIT_MS = 300_000;

const page = `<!doctype html><html><body><script type="importmap">{"imports": {
  "three": "/node_modules/three/build/three.module.js",
  "three/addons/": "/node_modules/three/examples/jsm/",
  "@sparkjsdev/spark": "/node_modules/@sparkjsdev/spark/dist/spark.module.min.js"}}</script>
<script type="module">
const say = (what, body) => fetch(what, { method: "POST", body });
try {
  const THREE = await import("three");
  const { SparkRenderer, SplatMesh } = await import("@sparkjsdev/spark");
  const job = await (await fetch("/job")).json();
  const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
  renderer.setPixelRatio(1);
  renderer.setSize(job.width, job.height);
  renderer.setClearColor(0x000000, 1);
  const scene = new THREE.Scene();
  // Everything that shapes the image is left at Spark's defaults.
  const spark = new SparkRenderer({ renderer, autoUpdate: false });
  scene.add(spark);
  const mesh = new SplatMesh({ fileBytes: await (await fetch("/model.ply")).arrayBuffer(), fileType: "ply" });
  await mesh.initialized;
  scene.add(mesh);
  const camera = new THREE.PerspectiveCamera(job.fov_deg, job.width / job.height, job.near, 1000);
  camera.matrixAutoUpdate = false;
  const gl = renderer.getContext();
  const bytes = new Uint8Array(job.width * job.height * 4), row = job.width * 4;
  for (let i = 0; i < job.poses.length; i++) {
    // three.js looks along -z with y up: the two middle axes of the optical frame change sign.
    const m = job.poses[i].flat();
    for (const j of [1, 2, 5, 6, 9, 10]) m[j] = -m[j];
    camera.matrix.set(...m);
    camera.updateMatrixWorld(true);
    await spark.update({ scene, camera });
    await spark.update({ scene, camera });
    renderer.render(scene, camera);
    gl.readPixels(0, 0, job.width, job.height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    const flipped = new Uint8Array(bytes.length);
    for (let y = 0; y < job.height; y++) flipped.set(bytes.subarray(y * row, (y + 1) * row), (job.height - 1 - y) * row);
    await say("/view/" + i, flipped);
  }
  await say("/done", JSON.stringify({ splats: mesh.packedSplats?.numSplats ?? mesh.numSplats,
    blurAmount: spark.blurAmount, preBlurAmount: spark.preBlurAmount }));
} catch (error) { await say("/failed", String(error?.stack ?? error)); }
</script></body></html>`;

const folder = mkdtempSync(join(tmpdir(), "spark-"));
let child, log = "";
const finish = (code, text) => {
  server.close();
  server.closeAllConnections();
  child?.once("exit", () => rmSync(folder, { recursive: true, force: true, maxRetries: 5 }));
  try { process.kill(-child.pid, "SIGTERM"); } catch { /* it ended by itself */ }
  (code ? process.stderr : process.stdout).write(text + "\n");
  process.exitCode = code;
};
const limit = setTimeout(() => finish(1, `Spark drew nothing within ${LIMIT_MS / 1000} s\n${log}`), LIMIT_MS);

const server = createServer((request, response) => {
  const path = normalize(new URL(request.url, "http://localhost").pathname);
  if (request.method === "POST") {
    const parts = [];
    request.on("data", (part) => parts.push(part)).on("end", () => {
      const body = Buffer.concat(parts);
      response.end();
      if (path.startsWith("/view/")) writeFileSync(join(job.out, `view_${Number(path.slice(6))}.rgba`), body);
      else { clearTimeout(limit); finish(path === "/done" ? 0 : 1, body.toString()); }
    });
  } else if (path === "/") response.setHeader("Content-Type", "text/html").end(page);
  else if (path === "/job") response.end(JSON.stringify(job));
  else if (path === "/model.ply") createReadStream(job.ply).pipe(response);
  else if (path.startsWith("/node_modules/")) {
    response.setHeader("Content-Type", path.endsWith("js") ? "text/javascript" : "application/octet-stream");
    createReadStream(join(here, path)).on("error", () => response.writeHead(404).end()).pipe(response);
  } else response.writeHead(404).end();
}).listen(0, "127.0.0.1", () => {
  child = spawn(job.chromium, ["--headless=new", "--no-sandbox", "--disable-gpu-sandbox", "--use-gl=angle",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-first-run",
    "--disable-extensions", "--disable-dev-shm-usage", "--mute-audio", "--disable-background-networking",
    `--user-data-dir=${folder}`, `http://127.0.0.1:${server.address().port}/`],
    { detached: true, stdio: ["ignore", "pipe", "pipe"], env: { ...process.env, HOME: folder } });
  child.on("error", (error) => { clearTimeout(limit); finish(1, String(error)); });
  for (const stream of [child.stdout, child.stderr]) stream.on("data", (text) => { log = (log + text).slice(-4000); });
});
