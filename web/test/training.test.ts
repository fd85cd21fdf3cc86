import { expect, test } from "vitest";

import { statusOf, statusText } from "../src/training";

test("status of a running training", () => {
  const status = statusOf({
    version: 3,
    stage: "textures",
    iteration: 120,
    iterations: 2000,
    loss: 0.12345,
    psnr: 21.5,
    num: 1500,
    bytes: 541792,
    is_paused: true,
  });
  expect(status?.version).toBe(3);
  expect(status && statusText(status)).toBe(
    "textures: 120 of 2,000, paused. Loss 0.1235, 21.50 dB, 1,500 Gaussians, 542 kB.",
  );
});

test("status of a training whose pictures equal their photographs", () => {
  const figures = { iteration: 120, iterations: 2000, loss: 0, psnr: null, num: 1500, bytes: 541792 };
  const status = statusOf({ version: 3, stage: "gaussians", ...figures });
  expect(status && statusText(status)).toBe("gaussians: 120 of 2,000. Loss 0.0000, 1,500 Gaussians, 542 kB.");
});

test("status of a training that is finishing", () => {
  const figures = { iteration: 120, iterations: 2000, loss: 0.1, psnr: 21.5, num: 1500, bytes: 541792 };
  const status = statusOf({ version: 3, stage: "textures", is_finishing: true, ...figures });
  expect(status && statusText(status)).toContain("120 of 2,000, finishing.");
});

test("status before the first figures, and a message in their place", () => {
  const [begins, staged, told] = [{}, { stage: "gaussians" }, { message: "cannot be shown" }].map((more) =>
    statusOf({ version: 0, ...more }),
  );
  expect(begins && statusText(begins)).toBe("Training is starting.");
  expect(staged && statusText(staged)).toBe("Stage gaussians is starting.");
  expect(told && statusText(told)).toBe("cannot be shown");
});

test.each([null, 3, "x", [], {}, { version: "1" }, { version: 0.5 }])("values that are no status: %o", (value) => {
  expect(statusOf(value)).toBeNull();
});
