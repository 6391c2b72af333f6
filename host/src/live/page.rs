//! What the page is made of.

/// A file of the page.
pub struct Asset {
    /// Where it is asked for.
    pub path: &'static str,
    /// What it is.
    pub content_type: &'static str,
    /// Its text.
    pub text: &'static str,
}

const JAVASCRIPT: &str = "text/javascript; charset=utf-8";

macro_rules! module {
    ($name:literal) => {
        Asset {
            path: concat!("/", $name),
            content_type: JAVASCRIPT,
            text: include_str!(concat!("page/", $name)),
        }
    };
}

/// All of them.
pub static ASSETS: [Asset; 18] = [
    Asset { path: "/", content_type: "text/html; charset=utf-8", text: include_str!("page/index.html") },
    Asset {
        path: "/style.css",
        content_type: "text/css; charset=utf-8",
        text: include_str!("page/style.css"),
    },
    Asset { path: "/icon.svg", content_type: "image/svg+xml", text: include_str!("page/icon.svg") },
    module!("main.js"),
    module!("link.js"),
    module!("model.js"),
    module!("trail.js"),
    module!("camera.js"),
    module!("gestures.js"),
    module!("paint.js"),
    module!("layer.js"),
    module!("palette.js"),
    module!("format.js"),
    module!("status.js"),
    module!("commands.js"),
    module!("timeline.js"),
    module!("tools.js"),
    module!("save.js"),
];
