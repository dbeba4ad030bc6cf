"use strict";
// The heads of tables become buttons that sort. Rows stay in their group, and what has no value comes last.

function written(row, column) {
  const cell = row.cells[column];
  const text = cell.dataset.value ?? cell.textContent.trim();
  return ["", "--", "none"].includes(text) ? null : text;
}

function numbered(text) {
  const found = /^(?:below )?([+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?)/i.exec(text);
  return found ? Number(found[1]) : null;
}

function sort(groups, column, direction) {
  for (const [body, rows] of groups) body.append(...rows);
  if (direction === "none") return;
  const all = groups.flatMap(([, rows]) => rows.map((row) => written(row, column)));
  const numeric = all.every((text) => text === null || numbered(text) !== null);
  const sign = direction === "ascending" ? 1 : -1;
  const compare = (a, b) =>
    numeric ? numbered(a) - numbered(b) : a.localeCompare(b, undefined, { numeric: true });
  for (const [body, rows] of groups) {
    const known = rows.filter((row) => written(row, column) !== null);
    const rest = rows.filter((row) => written(row, column) === null);
    known.sort((a, b) => sign * compare(written(a, column), written(b, column)));
    body.append(...known, ...rest);
  }
}

for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  const groups = [...table.tBodies].map((body) => [
    body,
    [...body.rows].filter((row) => !row.classList.contains("group")),
  ]);
  const after = { none: "descending", descending: "ascending", ascending: "none" };
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    head.setAttribute("aria-sort", "none");
    button.addEventListener("click", () => {
      const direction = after[head.getAttribute("aria-sort")];
      for (const other of heads) other.setAttribute("aria-sort", "none");
      head.setAttribute("aria-sort", direction);
      sort(groups, column, direction);
    });
  });
}
