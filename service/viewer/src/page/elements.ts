import { CATEGORIES, isHatched, type Category } from "../words/roof_types";

export type Child = Node | string | number | null | undefined | false;
export type Properties = Record<string, string | number | boolean | ((event: never) => void) | null | undefined>;

/**
 * An element with attributes (`on…` functions are listeners; null and false leave an attribute out) and children.
 *
 * Text is always text: nothing here parses HTML.
 */
export function el<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  properties: Properties = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  setProperties(element, properties);
  element.append(...present(children));
  return element;
}

/** The same for SVG. */
export function svg<K extends keyof SVGElementTagNameMap>(
  tag: K,
  properties: Properties = {},
  ...children: Child[]
): SVGElementTagNameMap[K] {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  setProperties(element, properties);
  element.append(...present(children));
  return element;
}

/** A button that does something. */
export function button(words: string, act: (() => void) | null, properties: Properties = {}): HTMLButtonElement {
  return el("button", { type: "button", ...properties, onclick: act }, words);
}

/** Whether a button is pressed, or to press it or release it. */
export const isPressed = (one: HTMLElement): boolean => one.getAttribute("aria-pressed") === "true";
export const setPressed = (one: HTMLElement, pressed: boolean): void => one.setAttribute("aria-pressed", String(pressed));

/** What keys do in an element; with Ctrl, Alt or the like they do what they do anywhere. */
export function onKeys(element: HTMLElement, keys: Readonly<Record<string, () => void>>): void {
  element.addEventListener("keydown", (event) => {
    const action = keys[event.key];
    if (action === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    action();
  });
}

/** Put something else into a place; a link that has the focus keeps it. */
export function refill(place: HTMLElement, ...content: Child[]): void {
  const focused = place.contains(document.activeElement) ? document.activeElement?.getAttribute("href") : null;
  place.replaceChildren(...present(content));
  if (focused != null) place.querySelector<HTMLAnchorElement>(`a[href="${CSS.escape(focused)}"]`)?.focus();
}

/** The element of the page with this id. */
export function byId<T extends HTMLElement = HTMLElement>(id: string): T {
  const element = document.getElementById(id);
  if (element === null) throw new Error(`the page has no element #${id}`);
  return element as T;
}

/** A small square in a category's colour, hatched where the models are. */
export function swatch(category: Category): HTMLElement {
  return colourSwatch(CATEGORIES[category].colour, isHatched(category));
}

/** A small square in a colour. */
export function colourSwatch(colour: string, hatched = false): HTMLElement {
  const square = el("span", { class: `swatch${hatched ? " swatch-hatched" : ""}`, "aria-hidden": "true" });
  // by the object model: the page's policy allows no style attributes
  square.style.backgroundColor = colour;
  return square;
}

function setProperties(element: Element, properties: Properties): void {
  for (const [name, value] of Object.entries(properties)) {
    if (value === null || value === undefined || value === false) continue;
    if (typeof value === "function") element.addEventListener(name.slice(2), value as EventListener);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
}

function present(children: Child[]): (Node | string)[] {
  return children.flatMap((child) =>
    child === null || child === undefined || child === false ? [] : [typeof child === "number" ? String(child) : child],
  );
}
