/** Chromium and an in-memory web server for tests. */

import { existsSync } from "node:fs";
import { createServer } from "node:http";
import type { AddressInfo } from "node:net";

import { chromium } from "playwright-core";
import type { Browser, BrowserContextOptions } from "playwright-core";

const PLACES = [process.env.CHROMIUM ?? "", "/usr/bin/chromium", "/usr/bin/chromium-browser", "/usr/bin/google-chrome"];
export const CHROMIUM = PLACES.find((path) => path !== "" && existsSync(path));

/** A page whose canvas has few pixels, because they are drawn in software. Its layout is that of any screen. */
export const DESK: BrowserContextOptions = { viewport: { width: 640, height: 480 }, deviceScaleFactor: 0.25 };

/** Launch Chromium headless, with WebGL 2 in software. */
export function launch(): Promise<Browser> {
  return chromium.launch({
    executablePath: CHROMIUM,
    args: [
      "--no-sandbox",
      "--disable-quic",
      "--no-first-run",
      "--disable-background-networking",
      "--disable-component-update",
      "--disable-sync",
      "--use-angle=swiftshader",
      "--enable-unsafe-swiftshader",
    ],
  });
}

export interface Served {
  readonly address: string;
  close(): void;
}

/** Serve files by path, such as "/scene.a2tgz". A function is called for each request. */
export function serve(
  files: Readonly<Record<string, Uint8Array | string | (() => Uint8Array | string)>>,
): Promise<Served> {
  const server = createServer((request, response) => {
    const found = Object.entries(files).find(([path]) => path === request.url)?.[1];
    const body = typeof found === "function" ? found() : found;
    const isPage = request.url === "/";
    response.writeHead(body === undefined ? 404 : 200, {
      "Content-Type": isPage ? "text/html" : "application/octet-stream",
    });
    response.end(body);
  });
  return new Promise((resolve) => {
    server.listen(0, "127.0.0.1", () => {
      const { port } = server.address() as AddressInfo;
      resolve({
        address: `http://127.0.0.1:${port}/`,
        close: () => {
          server.close();
          server.closeAllConnections();
        },
      });
    });
  });
}
