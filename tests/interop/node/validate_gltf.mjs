// Khronos glTF validator on one GLB file; its report as JSON on stdout.
import { readFile } from "node:fs/promises";
import validator from "gltf-validator";

const bytes = new Uint8Array(await readFile(process.argv[2]));
const report = await validator.validateBytes(bytes, { uri: "mesh.glb", format: "glb", maxIssues: 100 });
process.stdout.write(JSON.stringify(report));
