// Validate GLB files with Khronos' own validator: node benchmarks/validate_glb.mjs FILE.glb ...
// Needs the npm package: npm install gltf-validator (here, or in a folder named by GLTF_VALIDATOR_DIR).
// Prints one JSON line a file; exits 1 where any file has an error or a warning.
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { resolve } from "node:path";

const folder = process.env.GLTF_VALIDATOR_DIR ?? process.cwd();
const validator = createRequire(resolve(folder, "package.json"))("gltf-validator");

let failed = process.argv.length < 3;
for (const path of process.argv.slice(2)) {
  const report = await validator.validateBytes(new Uint8Array(readFileSync(path)));
  const { numErrors, numWarnings, numInfos, numHints, messages } = report.issues;
  failed ||= numErrors + numWarnings > 0;
  console.log(
    JSON.stringify({ path, numErrors, numWarnings, numInfos, numHints, messages: messages.slice(0, 20), info: report.info }),
  );
}
process.exit(failed ? 1 : 0);
