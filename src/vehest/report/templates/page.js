"use strict";

// Dark or light: as the reader's system says, until the button is pressed; a browser without storage for files forgets it.
const darkSystem = window.matchMedia("(prefers-color-scheme: dark)");
const page = document.documentElement;
const onTheme = [];

function isDark() {
  return page.dataset.theme ? page.dataset.theme === "dark" : darkSystem.matches;
}

{
  const button = document.getElementById("theme");
  const show = () => {
    button.textContent = isDark() ? "light page" : "dark page";
    onTheme.forEach((draw) => draw());
  };
  try {
    const stored = localStorage.getItem("vehest-theme");
    if (stored === "dark" || stored === "light") page.dataset.theme = stored;
  } catch {}
  button.hidden = false;
  button.addEventListener("click", () => {
    page.dataset.theme = isDark() ? "light" : "dark";
    try {
      localStorage.setItem("vehest-theme", page.dataset.theme);
    } catch {}
    show();
  });
  darkSystem.addEventListener("change", show);
  show();
}

// Appendices: one list of sections, closed until their heading is pressed, all open in print.
for (const node of document.querySelectorAll("#appendices ~ *")) {
  const heading = node.querySelector(":scope > h2");
  if (heading) {
    const [section, summary] = ["details", "summary"].map((name) => document.createElement(name));
    summary.append(heading);
    section.append(summary);
    node.before(section);
  }
  node.previousElementSibling?.matches("details") && node.previousElementSibling.append(node);
}
window.addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((section) => (section.open = true)));

// Contents: the headings above the appendices, whose list is their contents.
{
  const nav = document.querySelector("nav");
  [...document.querySelectorAll("h2")].filter((heading) => !heading.closest("details")).forEach((heading, i) => {
    if (!heading.id) heading.id = `part-${i}`;
    const link = document.createElement("a");
    link.href = `#${heading.id}`;
    link.textContent = heading.textContent;
    nav.append(link);
  });
  nav.hidden = nav.children.length < 2;
}

// Tables: a click on a header sorts by it, a second click the other way; missing values stay at the end.
for (const table of document.querySelectorAll("figure.table table")) {
  const body = table.tBodies[0];
  const headers = [...table.tHead.rows[0].cells].filter((header) => header.firstElementChild);
  const number = (text) => Number(text.replace(/[\u202f\s]/g, "").replace("\u2212", "-"));
  headers.forEach((header, column) => {
    header.firstElementChild.addEventListener("click", () => {
      const sign = header.getAttribute("aria-sort") === "ascending" ? -1 : 1;
      const numeric = header.classList.contains("number") || body.querySelector(`td:nth-child(${column + 1})[data-value]`);
      const text = (row) => row.cells[column].dataset.value ?? row.cells[column].firstChild.textContent.trim();
      const missing = (row) => text(row) === "\u2013";
      const rows = [...body.rows].sort((a, b) => {
        if (missing(a) || missing(b)) return missing(a) - missing(b);
        return sign * (numeric ? number(text(a)) - number(text(b)) : text(a).localeCompare(text(b)));
      });
      headers.forEach((other) => other.removeAttribute("aria-sort"));
      header.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
      body.append(...rows);
    });
  });
}

// Commands of a leaderboard's rows: shown below the table, and copied where the browser lets a file do so.
for (const button of document.querySelectorAll("button.command")) {
  button.addEventListener("click", async () => {
    const line = button.closest("figure").querySelector("p.command");
    const [code, note] = line.children;
    line.hidden = false;
    code.textContent = button.dataset.command;
    note.textContent = "";
    try {
      await navigator.clipboard.writeText(button.dataset.command);
      note.textContent = "copied";
    } catch {
      getSelection().selectAllChildren(code);
    }
  });
}
