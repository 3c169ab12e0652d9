// Stand-in for the part of Flamenco's manager that compiles jobs, written after the sources of Flamenco 3
// (internal/manager/job_compilers). It is not Flamenco: no manager has run the job type.
// Usage: node flamenco_stand_in.mjs JOB_TYPE.js, with {settings, created, chunks} as JSON on stdin. Prints JSON.

import { readFileSync } from "node:fs";
import path from "node:path/posix";
import vm from "node:vm";

// "1..10,20" or "1-10,20" in chunks of `size` frames; ranges of two frames are written as two frames.
function frameChunker(range, size) {
  if (range.trim() === "") throw new Error("empty range");
  if (!(size >= 1)) throw new Error(`invalid chunk size, must be positive number: ${size}`);
  const frames = new Set();
  for (const part of range.replaceAll("..", "-").split(",")) {
    const ends = part.split("-").map((text) => text.trim());
    if (ends.length > 2 || !ends.every((text) => /^\d+$/.test(text))) throw new Error(`invalid range "${range}": ${part}`);
    for (let frame = Number(ends[0]); frame <= Number(ends.at(-1)); frame++) frames.add(frame);
  }
  const sorted = [...frames].sort((a, b) => a - b);
  const chunks = [];
  for (let start = 0; start < sorted.length; start += size) chunks.push(merged(sorted.slice(start, start + size)));
  return chunks;
}

function merged(frames) {
  const runs = [];
  for (const frame of frames) {
    if (runs.length && frame === runs.at(-1).at(-1) + 1) runs.at(-1).push(frame);
    else runs.push([frame]);
  }
  return runs.map((run) => (run.length > 2 ? `${run[0]}-${run.at(-1)}` : run.join(","))).join(",");
}

// Local time as 2006-01-02_150405.
function formatTimestampLocal(date) {
  const [year, ...rest] = [date.getFullYear(), date.getMonth() + 1, date.getDate()];
  const two = (number) => String(number).padStart(2, "0");
  const time = [date.getHours(), date.getMinutes(), date.getSeconds()].map(two).join("");
  return `${year}-${rest.map(two).join("-")}_${time}`;
}

const author = {
  Task(name, type) {
    if (!name.trim() || !type.trim()) throw new Error("author.Task(name, type): name and type are required");
    const task = { name: name.trim(), type: type.trim(), commands: [], dependencies: [] };
    const functions = { addCommand: (one) => task.commands.push(one), addDependency: (one) => task.dependencies.push(one) };
    return Object.defineProperties(task, hidden(functions));
  },
  Command: (name, parameters, totalStepCount = 0) => ({ name, parameters, totalStepCount }),
};

function hidden(functions) {
  return Object.fromEntries(Object.entries(functions).map(([name, value]) => [name, { value }]));
}

const given = JSON.parse(readFileSync(0, "utf8"));
const tasks = [];
const job = { settings: given.settings, created: new Date(given.created), addTask: (task) => tasks.push(task) };
const quiet = () => undefined;
const world = vm.createContext({ author, path, frameChunker, formatTimestampLocal, print: quiet, alert: quiet });
// Flamenco compiles job types in strict mode.
vm.runInContext(`"use strict";\n${readFileSync(process.argv[2], "utf8")}\n;globalThis.found = { JOB_TYPE, compileJob };`, world);
const result = { jobType: world.found.JOB_TYPE };
result.chunks = (given.chunks ?? []).map(([range, size]) => frameChunker(range, size));
try {
  world.found.compileJob(job);
  Object.assign(result, { tasks, settings: job.settings });
} catch (error) {
  result.error = String(error);
}
console.log(JSON.stringify(result));
