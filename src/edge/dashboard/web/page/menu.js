// Menus that close by themselves: with Escape, and when something else is clicked.

export function closeByItself(menu) {
  document.addEventListener("pointerdown", (event) => {
    if (!menu.contains(event.target)) menu.open = false;
  });
  // Before anything else takes Escape for leaving the view.
  document.addEventListener(
    "keydown",
    (event) => {
      if (event.key !== "Escape" || !menu.open) return;
      event.stopPropagation();
      menu.open = false;
      menu.querySelector("summary").focus();
    },
    true,
  );
}
