"use strict";
// Figures of the page: their data stand beside them as JSON, and each is drawn once.
const toile = {
  json: (id) => JSON.parse(document.getElementById(id).textContent),

  floats: (base64) => new Float32Array(Uint8Array.from(atob(base64), (c) => c.charCodeAt(0)).buffer),

  drawFigures: () =>
    Promise.all(
      [...document.querySelectorAll("[data-figure]")].map((place) => {
        const figure = toile.json(place.dataset.figure);
        const config = { displayModeBar: false, responsive: true, showTips: false };
        return Plotly.newPlot(place, figure.data, figure.layout, config);
      }),
    ),
};
