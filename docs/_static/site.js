// Wide tables, equations and code scroll by themselves: let the keyboard reach them.
document.addEventListener("DOMContentLoaded", () => {
  for (const box of document.querySelectorAll("article table.docutils, article div.math, article .highlight pre")) {
    if (box.scrollWidth > box.clientWidth) box.tabIndex = 0;
  }
});
