// Small helpers around the document. Text from the network goes through `textContent` only, never through markup.

/** An element with attributes (`class`, `data-...`, `aria-...`, `text`) and children. */
export function element(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "text") node.textContent = value;
    else if (value === true) node.setAttribute(name, "");
    else if (value !== false && value != null) node.setAttribute(name, value);
  }
  node.append(...children);
  return node;
}

/** Writes text only where it changed: hundreds of tiles are updated twice a second. */
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

/** The same for an attribute. */
export function setAttribute(node, name, value) {
  if (node.getAttribute(name) !== value) node.setAttribute(name, value);
}

/** The same for whether it is hidden. */
export function setHidden(node, isHidden) {
  if (node.hidden !== isHidden) node.hidden = isHidden;
}

/** The element of the page with this id. */
export const byId = (id) => document.getElementById(id);

/** Whether somebody is typing, so that single letters are no commands. */
export function isTyping(target) {
  if (target instanceof HTMLTextAreaElement || target instanceof HTMLSelectElement) return true;
  return target instanceof HTMLInputElement && !["checkbox", "radio", "range"].includes(target.type);
}

/** Value of a setting that this browser keeps; `otherwise` where it keeps none or may not. */
export function recall(key, otherwise) {
  try {
    return localStorage.getItem(`hemostream.${key}`) ?? otherwise;
  } catch {
    return otherwise;
  }
}

/** Keeps a setting in this browser, where it allows that. */
export function remember(key, value) {
  try {
    localStorage.setItem(`hemostream.${key}`, value);
  } catch {
    // A browser that keeps nothing still shows everything.
  }
}
