// Keys, and what they do. The overlay that shows them is made from the same table.

import { byId, element, isTyping } from "./dom.js";

/** Starts listening; `table` is a list of `{names, keys, text, where, views, run}`, `view()` says which view is shown. */
export function startCommands(table, view) {
  const dialog = byId("keys");
  for (const { names, text, where } of table) {
    const keys = names.map((name) => element("kbd", { text: name }));
    const cells = [element("td", {}, ...keys), element("td", { text }), element("td", { class: "quiet", text: where })];
    byId("key-table").append(element("tr", {}, ...cells));
  }
  // Whoever presses a button with the pointer means Space to pause afterwards, not to press it again.
  document.addEventListener("click", (event) => {
    if (event.detail > 0) event.target.closest?.("button, summary, input[type=checkbox]")?.blur();
  });
  document.addEventListener("keydown", (event) => {
    // The dialog closes itself with Escape.
    if (event.ctrlKey || event.metaKey || event.altKey || dialog.open) return;
    if (isTyping(event.target)) {
      if (event.key === "Escape") event.target.blur();
      return;
    }
    const isButton = event.target.matches?.("button, summary, input[type=checkbox]");
    // Space and Enter on a button press it.
    if (isButton && (event.key === " " || event.key === "Enter")) return;
    const command = table.find(({ keys, views }) => keys.includes(event.key) && (!views || views.includes(view())));
    if (!command?.run) return;
    event.preventDefault();
    command.run(event.key);
  });
}
