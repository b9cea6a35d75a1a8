//! The page: its modules in one script, alone or inside a report.

use std::fmt::Write;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use super::protocol::Outgoing;

/// What the page may load: itself.
pub const POLICY: &str = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src blob: data:; \
                          connect-src 'self'; worker-src blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

const PAGE: &str = include_str!("page/page.html");
const STYLE: &str = include_str!("page/style.css");
/// In an order in which each comes after those that it uses.
const MODULES: [&str; 20] = [
    include_str!("page/math.js"),
    include_str!("page/dom.js"),
    include_str!("page/messages.js"),
    include_str!("page/connection.js"),
    include_str!("page/map_store.js"),
    include_str!("page/sorter.js"),
    include_str!("page/shaders.js"),
    include_str!("page/splats.js"),
    include_str!("page/scene.js"),
    include_str!("page/lines.js"),
    include_str!("page/controls.js"),
    include_str!("page/stage.js"),
    include_str!("page/plots.js"),
    include_str!("page/pictures.js"),
    include_str!("page/compare.js"),
    include_str!("page/panel.js"),
    include_str!("page/help.js"),
    include_str!("page/overlay.js"),
    include_str!("page/actions.js"),
    include_str!("page/main.js"),
];

/// The style, the script and the messages of a viewer inside another page, which has an element `#viewer`.
pub struct Embedded {
    /// For a `<style>` element.
    pub style: &'static str,
    /// For a `<script type="module">` element.
    pub script: String,
    /// Elements that hold the messages.
    pub messages: String,
}

/// The page that a server sends.
pub fn standalone(name: &str) -> String {
    let title = name.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
    let script = script();
    let parts = [("<!--MESSAGES-->", ""), ("/*STYLE*/", STYLE), ("/*SCRIPT*/", &script), ("<!--TITLE-->", title.as_str())];
    parts.iter().fold(PAGE.to_owned(), |page, (place, text)| page.replacen(place, text, 1))
}

/// A viewer of messages, for another page.
pub fn embedded(messages: &[Outgoing]) -> Embedded {
    let mut html = String::new();
    for message in messages {
        let (form, text) = match message {
            Outgoing::Text(text) => ("text", text.replace('<', "\\u003c")),
            Outgoing::Binary(bytes) => ("binary", STANDARD.encode(bytes)),
        };
        let _ = writeln!(html, "<script type=\"text/plain\" class=\"message\" data-form=\"{form}\">{text}</script>");
    }
    Embedded { style: STYLE, script: script(), messages: html }
}

/// All modules in one scope: imports are left out, exports are plain declarations.
fn script() -> String {
    let lines = MODULES.iter().flat_map(|module| module.lines()).filter(|line| !line.starts_with("import "));
    lines.fold(String::new(), |mut script, line| {
        script.push_str(line.strip_prefix("export ").unwrap_or(line));
        script.push('\n');
        script
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_script_is_one_scope_without_loads() {
        let script = script();
        assert!(!script.contains("</script") && !STYLE.contains("</style"));
        assert!(script.lines().all(|line| !line.starts_with("import ") && !line.starts_with("export ")));
        let mut names: Vec<&str> = script
            .lines()
            .filter_map(|line| {
                let line = line.strip_prefix("async ").unwrap_or(line);
                let rest = ["function ", "const ", "class ", "let "].iter().find_map(|word| line.strip_prefix(word))?;
                let end = rest.find(|c: char| !c.is_alphanumeric() && c != '_' && c != '$')?;
                // A constant in a shader's text has a type before its name.
                (line.starts_with("function ")
                    || !rest[end..].trim_start().starts_with(char::is_alphabetic)
                    || line.starts_with("class "))
                .then(|| &rest[..end])
            })
            .filter(|name| !name.is_empty())
            .collect();
        let count = names.len();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), count, "each name is declared once");
    }

    #[test]
    fn a_page_shows_its_name_and_nothing_that_it_could_run() {
        let page = standalone("<b>room</b> & hall");
        assert!(page.contains("&lt;b&gt;room&lt;/b&gt; &amp; hall") && !page.contains("<b>room"));
        for left in ["/*SCRIPT*/", "/*STYLE*/", "<!--TITLE-->", "<!--MESSAGES-->"] {
            assert!(!page.contains(left), "{left}");
        }
    }

    #[test]
    fn messages_cannot_end_their_element() {
        let text = Outgoing::Text(r#"{"name":"</script><script>alert(1)"}"#.into());
        let Embedded { messages, .. } = embedded(&[text, Outgoing::Binary(vec![1, 2, 3])]);
        assert_eq!(messages.matches("</script>").count(), 2);
        assert!(messages.contains("\\u003c/script>") && messages.contains("AQID"));
    }
}
