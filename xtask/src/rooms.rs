//! The directions of the dependencies between the modules of a crate, at every depth of its tree.

use crate::cargo;
use anyhow::{Context, Result};
use proc_macro2::{Delimiter, Group, Spacing, TokenStream, TokenTree};
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// The second workspace: its folder is one room.
const FIRMWARE: &str = "firmware-port";
/// The kinds of cargo targets whose modules are product code.
const PRODUCT: [&str; 4] = ["lib", "bin", "staticlib", "proc-macro"];

/// The product code of both workspaces.
pub(crate) struct Rooms(Vec<Room>);

/// A library or a program.
struct Room {
    package: String,
    /// The file of its root module, relative to the repository.
    file: String,
    tree: Tree,
}

impl Rooms {
    pub(crate) fn read(root: &Path) -> Result<Self> {
        let mut rooms = Vec::new();
        for workspace in [root, &root.join(FIRMWARE)] {
            for package in packages(workspace)? {
                for target in package.targets {
                    if !target
                        .kind
                        .iter()
                        .any(|kind| PRODUCT.contains(&kind.as_str()))
                    {
                        continue;
                    }
                    let mut tree = Tree::default();
                    tree.read(Vec::new(), &target.src_path, true)?;
                    let file = target.src_path.strip_prefix(root);
                    let file = file.unwrap_or(&target.src_path).display().to_string();
                    let package = package.name.clone();
                    rooms.push(Room {
                        package,
                        file,
                        tree,
                    });
                }
            }
        }
        Ok(Self(rooms))
    }

    /// Returns the cycles of dependencies between the modules of a folder.
    pub(crate) fn circles(&self) -> Vec<String> {
        let mut findings = Vec::new();
        for Room { file, tree, .. } in &self.0 {
            for (folder, circle) in tree.circles() {
                findings.push(format!(
                    "{file}: modules of crate::{folder} use each other: {circle:?}"
                ));
            }
        }
        findings
    }

    /// Returns each public type's name with the packages of the product that have such a type.
    pub(crate) fn public_types(&self) -> BTreeMap<String, BTreeSet<String>> {
        let mut types = BTreeMap::<String, BTreeSet<String>>::new();
        let product = self
            .0
            .iter()
            .filter(|room| !room.file.starts_with("tests/"));
        for Room { package, tree, .. } in product {
            for name in tree.0.values().flat_map(|module| &module.types) {
                types
                    .entry(name.clone())
                    .or_default()
                    .insert(package.clone());
            }
        }
        types
    }
}

/// The keywords before the name of an item.
const ITEMS: [&str; 9] = [
    "struct",
    "enum",
    "union",
    "trait",
    "type",
    "fn",
    "const",
    "static",
    "macro_rules",
];
/// The keywords before the name of a type.
const TYPES: [&str; 5] = ["struct", "enum", "union", "trait", "type"];
/// A name is followed through at most this many re-exports.
const IMPORTS: u32 = 4;

/// A package, as `cargo metadata` describes it.
#[derive(Deserialize)]
pub(crate) struct Package {
    pub(crate) name: String,
    pub(crate) dependencies: Vec<Dependency>,
    targets: Vec<Target>,
}

/// A dependency of a package.
#[derive(Deserialize)]
pub(crate) struct Dependency {
    pub(crate) name: String,
    /// `None` for a dependency at run time.
    pub(crate) kind: Option<String>,
    pub(crate) target: Option<String>,
}

/// A library or a program of a package.
#[derive(Deserialize)]
struct Target {
    kind: Vec<String>,
    src_path: PathBuf,
}

/// Returns the packages of the workspace in this folder.
pub(crate) fn packages(folder: &Path) -> Result<Vec<Package>> {
    #[derive(Deserialize)]
    struct Metadata {
        packages: Vec<Package>,
    }
    let output = cargo(folder, &["metadata", "--format-version=1", "--no-deps"]).output()?;
    let metadata: Metadata = serde_json::from_slice(&output.stdout).context("cargo metadata")?;
    Ok(metadata.packages)
}

/// Names from the crate's root, or from the module that contains the text.
type Names = Vec<String>;

/// The names and paths in one module.
#[derive(Default)]
struct Module {
    children: BTreeSet<String>,
    /// Names of the items that the module defines.
    items: BTreeSet<String>,
    /// The names of its public types.
    types: BTreeSet<String>,
    /// All paths in the code as written, including the items of `use` declarations.
    paths: BTreeSet<Names>,
    /// The names that `use` declarations import, with their paths: `*` for all names of a module.
    imports: Vec<(String, Names)>,
}

/// The modules of a crate, by their paths.
#[derive(Default)]
struct Tree(BTreeMap<Names, Module>);

impl Tree {
    /// Reads the module in this file, and its children.
    fn read(&mut self, at: Names, file: &Path, owns_folder: bool) -> Result<()> {
        let text = fs::read_to_string(file).with_context(|| file.display().to_string())?;
        let tokens: TokenStream = text
            .parse()
            .map_err(|error| anyhow::anyhow!("{}: {error}", file.display()))?;
        let files = self.add(at, tokens);
        let folder = match owns_folder {
            true => file.with_file_name(""),
            false => file.with_extension(""),
        };
        for child in files {
            let name = child.last().map(String::as_str).unwrap_or_default();
            let (alone, with_folder) = (
                folder.join(format!("{name}.rs")),
                folder.join(name).join("mod.rs"),
            );
            // A file at another location (`#[path]`) belongs to another crate.
            if alone.exists() {
                self.read(child, &alone, false)?;
            } else if with_folder.exists() {
                self.read(child, &with_folder, true)?;
            }
        }
        Ok(())
    }

    /// Adds a module without its tests, and returns its children in files.
    fn add(&mut self, at: Names, tokens: TokenStream) -> Vec<Names> {
        let mut module = Module::default();
        let mut files = Vec::new();
        let mut tokens = without_tests(tokens);
        for index in 0..tokens.len().saturating_sub(2) {
            let [word, name, behind] = [0, 1, 2].map(|further| tokens[index + further].clone());
            let TokenTree::Ident(word) = word else {
                continue;
            };
            if word == "pub" && TYPES.iter().any(|kind| name.to_string() == *kind) {
                module.types.insert(behind.to_string());
            } else if word == "mod" {
                let name = name.to_string();
                let child = [&at[..], std::slice::from_ref(&name)].concat();
                module.children.insert(name);
                match behind {
                    TokenTree::Group(inner) => {
                        files.extend(self.add(child, inner.stream()));
                        tokens[index + 2] = Group::new(Delimiter::Brace, TokenStream::new()).into();
                    }
                    _ => files.push(child),
                }
            } else if ITEMS.iter().any(|begin| word == begin) {
                module.items.insert(name.to_string());
            } else if word == "use" {
                let item = tokens[index + 1..].iter().take_while(|it| !is(it, ';'));
                let mut items = BTreeSet::new();
                paths(item.cloned(), &[], true, &mut items);
                for mut path in items {
                    // `use a::{self}`
                    path.pop_if(|name| name == "self");
                    if let Some(name) = path.last().cloned() {
                        let end = path.iter().position(|name| name == "as" || name == "*");
                        path.truncate(end.unwrap_or(path.len()));
                        module.imports.push((name, path));
                    }
                }
            }
        }
        paths(tokens.into_iter(), &[], false, &mut module.paths);
        self.0.insert(at, module);
        files
    }

    /// Returns the module that defines the item of this path, seen from module `at`. The search
    /// follows at most this many imports.
    fn home(&self, at: &[String], path: &[String], imports: u32) -> Option<Names> {
        let mut here = at.to_vec();
        for (index, name) in path.iter().enumerate() {
            let module = self.0.get(&here)?;
            match name.as_str() {
                "crate" => here.clear(),
                "self" => {}
                "super" => drop(here.pop()?),
                name if module.children.contains(name) => here.push(name.to_owned()),
                name if module.items.contains(name) => return Some(here),
                name => {
                    let imports = imports.checked_sub(1)?;
                    return module.imports.iter().find_map(|(known, from)| {
                        let rest = match known.as_str() {
                            "*" => &path[index..],
                            _ if known == name => &path[index + 1..],
                            _ => return None,
                        };
                        self.home(&here, &[from, rest].concat(), imports)
                    });
                }
            }
        }
        Some(here)
    }

    /// Returns every set of modules of one folder that use each other, with the folder's path.
    fn circles(&self) -> Vec<(String, BTreeSet<String>)> {
        let mut folders: BTreeMap<Names, Uses> = BTreeMap::new();
        for (at, module) in &self.0 {
            for path in &module.paths {
                let Some(home) = self.home(at, path, IMPORTS) else {
                    continue;
                };
                let shared = at.iter().zip(&home).take_while(|(a, b)| a == b).count();
                // A folder's own file is above the modules in it.
                if let (Some(user), Some(used)) = (at.get(shared), home.get(shared)) {
                    let uses = folders.entry(at[..shared].to_vec()).or_default();
                    uses.entry(used.clone()).or_default();
                    uses.entry(user.clone()).or_default().insert(used.clone());
                }
            }
        }
        let circles = folders
            .into_iter()
            .map(|(at, uses)| (at.join("::"), circle(&uses)));
        circles.filter(|(_, circle)| !circle.is_empty()).collect()
    }
}

fn is(token: &TokenTree, sign: char) -> bool {
    matches!(token, TokenTree::Punct(punct) if punct.as_char() == sign)
}

/// Returns the tokens without the items that only tests have.
fn without_tests(tokens: TokenStream) -> Vec<TokenTree> {
    let mut kept = Vec::new();
    let mut tokens = tokens.into_iter().peekable();
    while let Some(token) = tokens.next() {
        let attribute = tokens
            .peek()
            .filter(|_| is(&token, '#'))
            .map(ToString::to_string);
        let attribute = attribute.unwrap_or_default().replace(' ', "");
        if attribute.starts_with("[cfg(")
            && attribute.contains("test")
            && !attribute.contains("not(test")
        {
            let ends = |token: &TokenTree| match token {
                TokenTree::Group(group) => group.delimiter() == Delimiter::Brace,
                _ => is(token, ';'),
            };
            tokens.by_ref().find(ends);
        } else {
            kept.push(token);
        }
    }
    kept
}

/// Collects `a::b::c`, and `a::{b, c::d}` as two paths.
///
/// In an item of `use` an alias is the end of its path, and `*` is a name: `a::b as c` gives
/// `a::b::as::c`.
fn paths(
    tokens: impl Iterator<Item = TokenTree>,
    prefix: &[String],
    is_use: bool,
    into: &mut BTreeSet<Names>,
) {
    let mut path = prefix.to_vec();
    // Whether the next name continues the path.
    let mut continues = true;
    let mut tokens = tokens.peekable();
    while let Some(token) = tokens.next() {
        match &token {
            TokenTree::Ident(name) => {
                let is_alias = is_use && (name == "as" || path.ends_with(&["as".to_owned()]));
                if !continues && !is_alias {
                    into.insert(std::mem::replace(&mut path, prefix.to_vec()));
                }
                path.push(name.to_string());
                continues = false;
            }
            TokenTree::Punct(punct) if punct.as_char() == ':' => {
                let is_double = punct.spacing() == Spacing::Joint;
                if is_double && tokens.peek().is_some_and(|it| is(it, ':')) {
                    tokens.next();
                    continues = true;
                }
            }
            TokenTree::Group(group) => {
                let inner = without_tests(group.stream()).into_iter();
                let is_list = continues && path.len() > prefix.len();
                let prefix = if is_list { path.clone() } else { Vec::new() };
                paths(inner, &prefix, is_use, into);
            }
            all if is_use && is(all, '*') => path.push("*".to_owned()),
            _ => {
                into.insert(std::mem::replace(&mut path, prefix.to_vec()));
                continues = true;
            }
        }
    }
    into.insert(path);
}

/// For each module of a folder: the siblings that it uses.
type Uses = BTreeMap<String, BTreeSet<String>>;

/// Returns the modules that remain after repeatedly removing those that use no other, or that no
/// other uses.
fn circle(uses: &Uses) -> BTreeSet<String> {
    let mut left = uses.clone();
    loop {
        let free = |(name, used): &(&String, &BTreeSet<String>)| {
            !used.iter().any(|used| left.contains_key(used))
                || !left.values().any(|used| used.contains(*name))
        };
        let Some(name) = left.iter().find(free).map(|(name, _)| name.clone()) else {
            return left.into_keys().collect();
        };
        left.remove(&name);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tree(modules: &[(&str, &str)]) -> Tree {
        let mut tree = Tree::default();
        for (at, text) in modules {
            let at = at.split("::").filter(|name| !name.is_empty());
            tree.add(at.map(str::to_owned).collect(), text.parse().unwrap());
        }
        tree
    }

    /// Returns the cycles of a crate with the modules `a::{b, c}` and these texts.
    fn circles(a: &str, b: &str, c: &str) -> Vec<(String, BTreeSet<String>)> {
        tree(&[("", "mod a;"), ("a", a), ("a::b", b), ("a::c", c)]).circles()
    }

    #[test]
    fn modules_of_a_folder_that_use_each_other_are_found_by_each_kind_of_path() {
        let found = [("a".to_owned(), ["b", "c"].map(str::to_owned).into())];
        let c = "use crate::a::b::B; pub struct C; pub fn f() {}";
        for b in [
            "pub struct B; use super::c::C;",
            "pub struct B; fn f() { g(crate::a::c::f()) }",
            "pub struct B; use crate::{a::{c::{self, C}}};",
            "pub struct B; fn f() { println!(\"{}\", super::c::f()) }",
            "pub struct B; mod inner { use super::super::c::f; }",
            "pub struct B; use super::*; fn g() { c::f() }",
            // Through re-exports of the folder.
            "pub struct B; use super::C;",
            "pub struct B; use super::Renamed;",
            "pub struct B; use crate::a::f;",
        ] {
            let a = "mod b; mod c; pub use c::{C, C as Renamed}; pub use c::*;";
            assert_eq!(circles(a, b, c), found, "{b}");
        }
        for b in [
            "pub struct B; use super::A;",
            "pub struct B; #[cfg(test)] mod tests { use super::super::c::C; }",
            "pub struct B; // super::c::C",
            "pub struct B; use c::C;",
        ] {
            let a = "mod b; mod c; pub struct A; fn f() { b::g() }";
            assert_eq!(circles(a, b, c), [], "{b}");
        }
    }

    #[test]
    fn a_circle_of_the_top_modules_is_found_from_within_them() {
        let modules = [
            ("", "mod a; mod d; pub use d::D;"),
            ("a", "mod b;"),
            ("a::b", "use crate::D; pub fn f() {}"),
            ("d", "pub struct D; fn g() { crate::a::b::f() }"),
        ];
        let found = ["a", "d"].map(str::to_owned).into();
        assert_eq!(tree(&modules).circles(), [(String::new(), found)]);
    }

    #[test]
    fn only_the_modules_of_a_circle_are_named() {
        let uses = |arrows: &[(&str, &[&str])]| -> Uses {
            let names = |to: &[&str]| to.iter().map(ToString::to_string).collect();
            let arrows = arrows.iter();
            arrows
                .map(|(from, to)| (from.to_string(), names(to)))
                .collect()
        };
        let tree = uses(&[("a", &["b", "c"]), ("b", &["c"]), ("c", &[])]);
        assert_eq!(circle(&tree), BTreeSet::new());
        let round = uses(&[("a", &["b"]), ("b", &["c", "d"]), ("c", &["b"]), ("d", &[])]);
        assert_eq!(circle(&round), ["b", "c"].map(str::to_owned).into());
    }
}
