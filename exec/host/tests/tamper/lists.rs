//! Lists that are signed by a good key, and must be refused all the same.

use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use sha2::{Digest as _, Sha256};
use tandem_boot_host::SigningKey;
use tandem_exec_host::trust::sign;

use crate::fixture::{ANCHOR, Fixture, KEY, LIST, MANIFEST, Outcome, RETIRED};

/// Returns a text with a signature under it.
fn signed(text: &str, key: &SigningKey) -> String {
    let signature = key
        .sign(text.as_bytes())
        .map(|byte| format!("{byte:02x}"))
        .concat();
    format!("{text}# signature {} {signature}\n", key.number)
}

/// Calls `count` with each refusal that is due, and its outcome.
pub(crate) fn each(fixture: &Fixture, mut count: impl FnMut(String, Outcome)) {
    let list = String::from_utf8(fixture.good[LIST].clone()).unwrap();
    let text = &list[..list.rfind("# signature ").unwrap()];
    let mut attempt = |case: &str, list: String, due: &str| {
        fixture.write(LIST, list.as_bytes());
        let outcome = fixture.attempt("bin/static", || {});
        fixture.restore(LIST);
        if let Outcome::Refused(why) = &outcome {
            assert!(why.contains(due), "{case}: {why}");
            assert!(
                why.starts_with("IntegrityOrAuthenticityCheckFailed"),
                "{why}"
            );
        }
        count(format!("list: {case}"), outcome);
    };
    let unknown = SigningKey {
        number: 2,
        seed: [9; 32],
    };
    let other = SigningKey {
        number: 1,
        ..unknown
    };
    attempt("retired key", signed(text, &RETIRED), "retired key");
    attempt("unknown key", signed(text, &unknown), "unknown");
    attempt(
        "number of a key that did not sign",
        signed(text, &other),
        "not verify",
    );
    let number = |number: &str| list.replace("# signature 1 ", &format!("# signature {number} "));
    for wrong in ["01", "+1", "0", "255", "256", "", "1 1"] {
        attempt(&format!("key {wrong:?}"), number(wrong), "");
    }
    attempt(
        "two signatures",
        signed(&list, &KEY).replace("# signature", "# Signature"),
        "",
    );
    attempt("no signature", text.to_owned(), "not verify");
    attempt("empty", String::new(), "not verify");
    attempt("large digits", list.to_uppercase(), "not verify");

    let mut change = |case: &str, from: &str, to: &str, due: &str| {
        assert!(text.contains(from), "{from}");
        attempt(case, signed(&text.replace(from, to), &KEY), due);
    };
    change(
        "older platform",
        "security-counter = 5",
        "security-counter = 4",
        "security counter",
    );
    change("unknown version", "version = 1", "version = 2", "version 2");
    change(
        "unknown field",
        "version = 1",
        "version = 1\nextra = 1",
        "extra",
    );
    change(
        "another manifest's list",
        MANIFEST,
        "other.toml",
        "not in the list",
    );
    change(
        "no manifest",
        "kind = \"manifest\"",
        "kind = \"library\"",
        "0 manifests",
    );
    change(
        "a folder up",
        "path = \"bin/static\"",
        "path = \"bin/../bin/static\"",
        "plain path",
    );
    change(
        "a folder up at once",
        "path = \"bin/static\"",
        "path = \"../static\"",
        "plain path",
    );
    change(
        "this folder",
        "path = \"bin/static\"",
        "path = \"./bin/static\"",
        "plain path",
    );
    change(
        "no path",
        "path = \"bin/static\"",
        "path = \"\"",
        "plain path",
    );
    change(
        "no such program",
        "name = \"bin/static\"",
        "name = \"bin/other\"",
        "not in the list",
    );
    change(
        "two of one name",
        "name = \"bin/script\"",
        "name = \"bin/static\"",
        "twice",
    );
    let length = format!("length = {}\n", fixture.good["bin/static"].len());
    for wrong in ["0", "1", "9223372036854775807"] {
        let to = format!("length = {wrong}\n");
        change(&format!("length {wrong}"), &length, &to, "length");
    }
    change("a negative length", &length, "length = -1\n", "not a list");
    change("a short SHA-256", "sha256 = \"", "sha256 = \"0", "SHA-256");
    let library = "name = \"libfirst.so\"";
    let due = "not in the list";
    let renamed = text.replace(library, "name = \"libother.so\"");
    fixture.write(LIST, signed(&renamed, &KEY).as_bytes());
    let outcome = fixture.attempt("bin/dynamic", || {});
    assert!(
        matches!(&outcome, Outcome::Refused(why) if why.contains(due)),
        "{outcome:?}"
    );
    fixture.restore(LIST);
    let link = fixture.path("linked");
    std::os::unix::fs::symlink(fixture.path("bin"), &link).unwrap();
    let linked = text.replace("path = \"bin/static\"", "path = \"linked/static\"");
    fixture.write(LIST, signed(&linked, &KEY).as_bytes());
    count(
        "list: a path through a link".into(),
        fixture.attempt("bin/static", || {}),
    );
    fixture.restore(LIST);
    std::fs::remove_file(Path::new(&link)).unwrap();
    assert_eq!(
        fixture.attempt("bin/static", || {}),
        fixture.expected("bin/static")
    );
}

/// E-4: a library whose auditors or filters the loader would read by their paths is neither signed
/// nor started, also if a good key has signed it.
#[test]
fn auditors_and_filters_are_refused() {
    let fixture = Fixture::new();
    let file = "lib/libsecond.so";
    let entry = |bytes: &[u8]| {
        let digest = Sha256::digest(bytes);
        let digits = digest.iter().map(|byte| format!("{byte:02x}"));
        let digits = digits.collect::<String>();
        format!("length = {}\nsha256 = \"{digits}\"", bytes.len())
    };
    let list = String::from_utf8(fixture.good[LIST].clone()).unwrap();
    let text = &list[..list.rfind("# signature ").unwrap()];
    let good = entry(&fixture.good[file]);
    assert!(text.contains(&good), "{good}");
    for word in ["--audit", "--depaudit", "--filter", "--auxiliary"] {
        let mut cc = Command::new("cc");
        cc.args(["-shared", "-fPIC", "-nostdlib", "-DTOKEN=\"\""]);
        cc.arg("-Wl,-soname,libsecond.so");
        cc.arg(format!("-Wl,{word}=libc.so.6")).arg("-o");
        cc.arg(fixture.path(file)).arg(concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/tests/tamper/programs/second.c"
        ));
        assert!(cc.status().expect("cc").success(), "{cc:?}");
        let programs = [PathBuf::from("bin/dynamic")];
        let signature = |message: &[u8]| KEY.sign(message);
        let refused = sign(&fixture.path(MANIFEST), &programs, 5, KEY.number, signature);
        let why = refused.unwrap_err().to_string();
        assert!(why.contains("auditors or filters"), "{word}: {why}");
        let changed = text.replace(&good, &entry(&fixture.read(file)));
        fixture.write(LIST, signed(&changed, &KEY).as_bytes());
        let outcome = fixture.attempt("bin/dynamic", || {});
        assert!(
            matches!(&outcome, Outcome::Refused(why) if why.contains("auditors or filters")),
            "{word}: {outcome:?}"
        );
    }
    fixture.restore(file);
    fixture.restore(LIST);
    let outcome = fixture.attempt("bin/dynamic", || {});
    assert_eq!(outcome, fixture.expected("bin/dynamic"));
}

/// E-4: an anchor that every user may write proves nothing.
#[test]
fn an_anchor_that_every_user_may_write_is_refused() {
    let fixture = Fixture::new();
    for (mode, is_good) in [(0o646, false), (0o602, false), (0o644, true), (0o660, true)] {
        std::fs::set_permissions(fixture.path(ANCHOR), Permissions::from_mode(mode)).unwrap();
        match fixture.attempt("bin/static", || {}) {
            Outcome::Refused(why) => assert!(!is_good && why.contains("every user"), "{why}"),
            outcome => assert_eq!((outcome, is_good), (fixture.expected("bin/static"), true)),
        }
    }
}
