"use strict";

// Tables: a click on a header sorts by it, a second click the other way; missing values stay at the end.
for (const table of document.querySelectorAll("figure.table table")) {
  const body = table.tBodies[0];
  const headers = [...table.tHead.rows[0].cells];
  const number = (text) => Number(text.replace(/[\u202f\s]/g, "").replace("\u2212", "-"));
  headers.forEach((header, column) => {
    header.firstElementChild.addEventListener("click", () => {
      const sign = header.getAttribute("aria-sort") === "ascending" ? -1 : 1;
      const numeric = header.classList.contains("number");
      const text = (row) => row.cells[column].textContent;
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

// Figures: drawn by the library inside this file, in the colours of the page.
const dark = window.matchMedia("(prefers-color-scheme: dark)");
const touch = window.matchMedia("(pointer: coarse)").matches;
const plots = [];

function dressed(plot) {
  const colours = getComputedStyle(document.documentElement);
  const value = (name) => colours.getPropertyValue(name).trim();
  const layout = structuredClone(plot.layout);
  const data = plot.data.map((trace) => {
    if (!trace.meta) return trace;
    return { ...trace, line: { ...trace.line, color: dark.matches ? trace.meta.dark : trace.line.color } };
  });
  layout.paper_bgcolor = layout.plot_bgcolor = "rgba(0,0,0,0)";
  layout.font = { ...layout.font, color: value("--ink") };
  layout.hoverlabel = { bgcolor: value("--stripe"), bordercolor: value("--rule"), font: { color: value("--ink") } };
  for (const [key, axis] of Object.entries(layout)) {
    if (!/^[xy]axis\d*$/.test(key)) continue;
    Object.assign(axis, { gridcolor: value("--grid"), zerolinecolor: value("--rule"), linecolor: value("--rule") });
    if (axis.rangeslider) Object.assign(axis.rangeslider, { bgcolor: value("--stripe"), bordercolor: value("--rule") });
  }
  layout.modebar = { ...layout.modebar, color: value("--soft"), activecolor: value("--accent") };
  if (touch) layout.dragmode = false;
  return [data, layout];
}

function viewsOf(place, plot) {
  const views = document.createElement("div");
  views.className = "views";
  for (const [label, range] of Object.entries(plot.layout.meta?.views || {})) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = label;
    button.addEventListener("click", () => Plotly.relayout(place, { "xaxis.range": [...range], "xaxis2.range": [...range] }));
    views.append(button);
  }
  return views;
}

if (window.Plotly) {
  for (const figure of document.querySelectorAll("figure.live")) {
    const plot = JSON.parse(figure.querySelector("script").textContent);
    const place = figure.querySelector(".plot");
    figure.classList.add("drawn");
    Plotly.newPlot(place, ...dressed(plot), {
      responsive: true,
      displaylogo: false,
      displayModeBar: touch ? false : "hover",
      modeBarButtons: [["zoom2d", "pan2d", "resetScale2d", "toImage"]],
    });
    plots.push([place, plot]);
    figure.prepend(viewsOf(place, plot));
  }
  dark.addEventListener("change", () => plots.forEach(([place, plot]) => Plotly.react(place, ...dressed(plot))));
}
