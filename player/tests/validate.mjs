// Khronos validator: prints one JSON report for each file. Usage: node validate.mjs FILE...
import fs from "node:fs";
import validator from "gltf-validator";

for (const path of process.argv.slice(2)) {
  const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(path)), { maxIssues: 100000 });
  console.log(JSON.stringify(report.issues));
}
