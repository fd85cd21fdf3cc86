/** Makes one page of what Vite builds: script and style inside, and a policy that allows nothing else. */

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

export function onefile(): Plugin {
  return {
    name: "onefile",
    enforce: "post",
    generateBundle(_, bundle) {
      const files = Object.values(bundle);
      const scripts = files.filter((file) => file.type === "chunk");
      const styles = files.filter((file) => file.type === "asset" && file.fileName.endsWith(".css"));
      const page = files.find((file) => file.fileName === "index.html");
      if (scripts.length !== 1 || styles.length !== 1 || page?.type !== "asset") {
        throw new Error("one script, one style sheet and one page are wanted");
      }
      const script = `\n${scripts[0].code.replaceAll("</script", "<\\/script").trim()}\n`;
      const style = `\n${String((styles[0] as { source: unknown }).source).trim()}\n`;
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
