// A table that is wider than its place gets smaller letters, or becomes a card for each row: nothing of it is hidden.
document.addEventListener("DOMContentLoaded", () => {
  const tables = [...document.querySelectorAll("table.docutils")];
  for (const table of tables) {
    const heads = [...table.querySelectorAll("thead th")].map(head => head.textContent.trim());
    for (const row of table.querySelectorAll("tbody tr"))
      [...row.cells].forEach((cell, k) => { if (heads[k]) cell.dataset.head = heads[k]; });
  }
  const fit = () => {
    for (const table of tables) {
      table.classList.remove("tight", "stacked");
      for (const smaller of ["tight", "stacked"])
        if (table.scrollWidth > table.parentElement.clientWidth + 1) table.classList.add(smaller);
    }
  };
  fit();
  addEventListener("resize", fit);
});
