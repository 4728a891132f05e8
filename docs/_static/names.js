// Names for screen readers that the theme and the gallery leave out.
document.addEventListener("DOMContentLoaded", () => {
  for (const card of document.querySelectorAll(".sphx-glr-thumbcontainer")) {
    const title = card.querySelector(".sphx-glr-thumbnail-title");
    for (const link of card.querySelectorAll("a")) link.setAttribute("aria-label", title?.textContent ?? "example");
  }
  for (const summary of document.querySelectorAll("summary")) {
    if (summary.textContent.trim()) continue;
    const section = summary.closest("li")?.querySelector("a")?.textContent ?? "pages";
    summary.setAttribute("aria-label", `Show pages of ${section.trim()}`);
  }
});
