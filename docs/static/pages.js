// What scrolls can be reached by the keyboard; a signature over several lines is no list of definitions.
window.addEventListener("load", () => {
  const reachable = () => {
    for (const one of document.querySelectorAll("pre, .table-wrapper, .formula"))
      if (one.scrollWidth > one.clientWidth) one.tabIndex = 0;
  };
  for (const one of document.querySelectorAll("dt.sig dl, dt.sig dl > dd")) one.setAttribute("role", "none");
  reachable();
  window.addEventListener("resize", reachable);
});
