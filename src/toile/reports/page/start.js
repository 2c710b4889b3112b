"use strict";
// Draw everything; <html data-ready> tells that it is done.
toile.makeTablesSortable();
toile
  .drawFigures()
  .then(() => (document.getElementById("viewer") ? toile.startViewer() : undefined))
  .then(() => (document.documentElement.dataset.ready = "true"));
