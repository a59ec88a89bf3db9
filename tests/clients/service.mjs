// Shared parts of the tests in JavaScript: a service of their own, a browser, and a line for each
// check.
import assert from "node:assert/strict";
import { spawn } from "node:child_process";
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";

export const VPD = process.env.VPD ?? "target/release/vpd";

// Starts `vpd serve` on a free port; `stop()` ends it.
export async function service(args = [], env = {}) {
  const data = mkdtempSync(join(tmpdir(), "vpd-"));
  const child = spawn(VPD, ["serve", "--listen", "127.0.0.1:0", "--data", data, ...args],
    { stdio: ["ignore", "ignore", "pipe"], env: { ...process.env, ...env } });
  let words = "";
  const url = await new Promise((resolve, reject) => {
    child.stderr.on("data", piece => {
      words += piece;
      const found = /listening on (http:\/\/[\d.:]+)/.exec(words);
      if (found) resolve(found[1]);
    });
    child.on("exit", code => reject(new Error(`vpd serve ended with ${code}: ${words}`)));
  });
  // A check that fails leaves its service: it ends with this process, which does not wait for it.
  process.on("exit", () => child.kill());
  child.unref();
  child.stderr.unref();
  const stop = async () => {
    const gone = new Promise(resolve => child.on("exit", resolve));
    child.ref();
    child.kill("SIGTERM");
    await gone;
    rmSync(data, { recursive: true, force: true });
  };
  return { url, stop };
}

export async function submit(url, scenario) {
  const answer = await fetch(`${url}/jobs`, { method: "POST", body: JSON.stringify(scenario), headers: { "content-type": "application/json" } });
  assert.equal(answer.status, 202, await answer.clone().text());
  return answer.json();
}

export async function ended(url, id) {
  for (;;) {
    const job = await (await fetch(`${url}/jobs/${id}`)).json();
    if (["succeeded", "failed", "cancelled"].includes(job.state)) return job;
    await new Promise(later => setTimeout(later, 50));
  }
}

export const shipped = async (url, name) => (await fetch(`${url}/scenarios/${name}`)).json();

// Chromium; or Firefox, as Debian packages it, if that is asked for. Playwright drives it by WebDriver BiDi, of which the
// long-term Firefox knows too little for versions after 1.64.
export const FIREFOX = process.env.BROWSER === "firefox";

export async function browser(args = []) {
  const { chromium, firefox } = await import("playwright-core");
  if (FIREFOX) return firefox.launch({ channel: "moz-firefox", executablePath: process.env.FIREFOX ?? "/usr/bin/firefox-esr" });
  return chromium.launch({
    executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
    args: ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
      "--disable-component-update", "--disable-sync", ...args],
  });
}

// Runs checks one after another and reports each; the process fails if one does.
export async function checks(all) {
  let failed = 0;
  for (const [name, check] of Object.entries(all)) {
    try {
      const detail = await check();
      console.log(`pass  ${name}${detail ? `: ${detail}` : ""}`);
    } catch (error) {
      failed += 1;
      console.log(`FAIL  ${name}: ${error.stack ?? error}`);
    }
  }
  console.log(`${Object.keys(all).length - failed} passed, ${failed} failed`);
  process.exitCode = failed ? 1 : 0;
}
