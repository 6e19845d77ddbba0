// Solves a table of observations: npx tsx solve.ts http://127.0.0.1:50051 observations.csv 1000 1000
import { readFileSync } from "node:fs";
import { randomUUID } from "node:crypto";
import { Code, ConnectError, createClient } from "@connectrpc/connect";
import { createGrpcTransport } from "@connectrpc/connect-node";
import { JobState } from "./gen/scpsfm/v1/job_pb.js";
import { JobService } from "./gen/scpsfm/v1/job_service_pb.js";
import { Grade } from "./gen/scpsfm/v1/result_pb.js";

const [baseUrl, path, width, height] = process.argv.slice(2);
if (!baseUrl || !path || !width || !height) throw new Error("usage: solve.ts URL CSV WIDTH HEIGHT");

const [header, ...lines] = readFileSync(path, "utf8").trim().split(/\r?\n/).map((line) => line.split(","));
const column = (name: string) => lines.map((line) => Number(line[header.indexOf(name)]));
const [viewIndices, trackIndices] = [column("view"), column("track")];
const count = (indices: number[]) => indices.reduce((most, index) => Math.max(most, index + 1), 0);
const size = { widthPx: Number(width), heightPx: Number(height) };

const jobs = createClient(JobService, createGrpcTransport({ baseUrl }));
const job = await jobs.createJob({
  requestId: randomUUID(),
  source: {
    case: "trackSet",
    value: {
      trackCount: count(trackIndices),
      views: Array.from({ length: count(viewIndices) }, () => ({ size })),
      viewIndices,
      trackIndices,
      xs: column("x"),
      ys: column("y"),
    },
  },
});

// The number of the last event: a stream that breaks off goes on after it.
let sequence = 0n;
for (let isOver = false; !isOver; ) {
  try {
    for await (const event of jobs.watchJob({ name: job.name, afterSequence: sequence })) {
      sequence = event.sequence || sequence;
      if (event.body.case === "progress") console.error(`${Math.round(100 * event.body.value.fraction)} %`);
    }
    isOver = true;
  } catch (error) {
    if (ConnectError.from(error).code !== Code.Unavailable) throw error;
    await new Promise((resolve) => setTimeout(resolve, 1000));
  }
}

const ended = await jobs.getJob({ name: job.name });
if (ended.state !== JobState.SUCCEEDED) throw new Error(`${JobState[ended.state]}: ${ended.error?.message}`);
const result = await jobs.getJobResult({ name: job.name });
console.log("grade", Grade[result.grade]);
console.log("inlier tracks", result.tracks?.inliers.filter(Boolean).length);
for (const { cameraGroup, focalPx, sigmaLogFocal } of result.calibrations) {
  console.log("focal", cameraGroup, focalPx.toFixed(1), "+-", ((sigmaLogFocal ?? Infinity) * focalPx).toFixed(1));
}
