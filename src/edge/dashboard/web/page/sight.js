// Which elements are in sight: what nobody sees need not be drawn.

const inSight = new WeakSet();
const observer = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) {
    if (isIntersecting) inSight.add(target);
    else inSight.delete(target);
  }
});

/** Keeps an eye on an element from now on. */
export function watch(node) {
  observer.observe(node);
}

/** Ends that. */
export function unwatch(node) {
  observer.unobserve(node);
  inSight.delete(node);
}

/** Whether an element that is watched is in sight. */
export const isInSight = (node) => inSight.has(node);
