/** Vite plugin that inlines script and style into one page, with a content security policy that allows no other. */

import { createHash } from "node:crypto";
import type { Plugin } from "vite";

const hash = (text: string): string => `'sha256-${createHash("sha256").update(text).digest("base64")}'`;

function policy(script: string, style: string): string {
  return [
    "default-src 'none'",
    `script-src ${hash(script)}`,
    `style-src ${hash(style)}`,
    "worker-src blob:",
    "connect-src 'self'",
    "img-src 'self' data:",
    "base-uri 'none'",
    "form-action 'none'",
  ].join("; ");
}

/** Return the only element. Throws an Error if there are none or several. */
function only<T>(found: readonly T[], what: string): T {
  const [first] = found;
  if (first === undefined || found.length > 1) {
    throw new Error(`Expected one ${what} in the build, found ${found.length}.`);
  }
  return first;
}

export function onefile(): Plugin {
  return {
    name: "onefile",
    apply: (config, { command }) => command === "build" && config.build?.ssr === undefined,
    enforce: "post",
    generateBundle(_, bundle) {
      const files = Object.values(bundle);
      const scripts = files.filter((file) => file.type === "chunk");
      const assets = files.filter((file) => file.type === "asset");
      const styles = assets.filter((file) => file.fileName.endsWith(".css"));
      const [code, sheet] = [only(scripts, "script").code, only(styles, "style sheet").source];
      const page = only(
        assets.filter((file) => file.fileName === "index.html"),
        "page",
      );
      const script = `\n${code.replaceAll("</script", "<\\/script").trim()}\n`;
      const style = `\n${String(sheet).trim()}\n`;
      const inside = [
        `<meta http-equiv="Content-Security-Policy" content="${policy(script, style)}" />`,
        `<style>${style}</style>`,
      ].join("\n    ");
      const bare = String(page.source)
        .replace(/\s*<script type="module"[^>]*><\/script>/, "")
        .replace(/\s*<link rel="stylesheet"[^>]*>/, "");
      page.source = bare
        .replace('<meta charset="utf-8" />', () => `<meta charset="utf-8" />\n    ${inside}`)
        .replace("</body>", () => `<script type="module">${script}</script>\n  </body>`);
      for (const file of [...scripts, ...styles]) Reflect.deleteProperty(bundle, file.fileName);
    },
  };
}
