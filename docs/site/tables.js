// Commands in tables have a button that copies them, as blocks of code do.
for (const code of document.querySelectorAll("td code")) {
  const text = code.textContent.trim();
  if (!text.includes(" ") || !/^(unips|python|pip) /.test(text)) continue;
  const button = document.createElement("button");
  button.type = "button";
  button.className = "copy-command md-icon";
  button.title = "Copy to clipboard";
  button.setAttribute("aria-label", `Copy: ${text}`);
  button.onclick = async () => {
    await navigator.clipboard.writeText(text);
    button.classList.add("copied");
    setTimeout(() => button.classList.remove("copied"), 1500);
  };
  code.after(button);
}
