//! A browser for the page, where there is one.

/// Why no browser was opened.
#[derive(Debug, thiserror::Error)]
pub enum NoBrowser {
    /// Nothing could be seen: there is no display.
    #[error("there is no display")]
    NoDisplay,
    /// None could be opened.
    #[error("{0}")]
    Failed(#[from] std::io::Error),
}

/// Variables of which one says that there is a display, where systems run without one.
const DISPLAYS: [&str; 3] = ["DISPLAY", "WAYLAND_DISPLAY", "WSL_DISTRO_NAME"];

/// Opens an address in the user's browser. Without a display none is looked for: what is found there would take over the terminal.
pub fn show(url: &str) -> Result<(), NoBrowser> {
    let is_set = |name: &&str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    if cfg!(all(unix, not(target_os = "macos"))) && !DISPLAYS.iter().any(is_set) {
        return Err(NoBrowser::NoDisplay);
    }
    Ok(open::that_detached(url)?)
}
