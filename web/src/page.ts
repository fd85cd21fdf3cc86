/** Access to the page's elements by id. Text from files is set as text, never as markup. */

export function element<T extends HTMLElement>(id: string, kind: new () => T): T {
  const found = document.getElementById(id);
  if (!(found instanceof kind)) throw new Error(`The page has no #${id} of the right type.`);
  return found;
}

export function setText(id: string, text: string): void {
  const found = element(id, HTMLElement);
  found.textContent = text;
  found.hidden = text === "";
}

export function showMessage(text: string): void {
  setText("message", text);
  element("progress", HTMLProgressElement).hidden = true;
}

/** Replace the list of figures with these pairs of name and value. */
export function setFigures(figures: readonly (readonly [string, string])[]): void {
  const list = element("figures", HTMLElement);
  const terms = figures.flatMap(([name, value]) => {
    const [term, data] = [document.createElement("dt"), document.createElement("dd")];
    term.textContent = name;
    data.textContent = value;
    return [term, data];
  });
  list.replaceChildren(...terms);
}

export function bytesText(num: number): string {
  return num < 1e6 ? `${(num / 1e3).toFixed(0)} kB` : `${(num / 1e6).toFixed(num < 1e7 ? 2 : 1)} MB`;
}

export const countText = (num: number): string => num.toLocaleString("en");
