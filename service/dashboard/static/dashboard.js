// htmx polls. This stops it where nobody looks, says when what is shown may be old, and asks before a job is cancelled.
"use strict";

const isLive = document.getElementById("is-live");
document.getElementById("live-switch").hidden = !document.getElementById("live");

document.addEventListener("htmx:beforeRequest", (event) => {
  if (document.hidden || !isLive.checked) event.preventDefault();
});
document.addEventListener("htmx:afterRequest", (event) => {
  document.getElementById("stale").hidden = event.detail.successful === true;
});
document.addEventListener("submit", (event) => {
  const question = event.target.dataset.confirm;
  if (question && !window.confirm(question)) event.preventDefault();
});
