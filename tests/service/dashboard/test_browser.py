"""The dashboard in a real browser: it stays live, obeys its own policy, and can be used with keys and on a phone."""

import json

import pytest
from sqlalchemy.exc import OperationalError

from service.keys import revoke_key
from workers.jobs.store import JobStore

TAB, ENTER = ("Tab", 9), ("Enter", 13)


def says(text):
    return f"document.body.innerText.includes({json.dumps(text)})"


def tab_to(browser, name):
    """Press Tab until the element of an id has the focus."""
    for _ in range(50):
        browser.press(*TAB)
        if browser.ask("document.activeElement.id") == name:
            return
    pytest.fail(f"no Tab reaches {name}")


def test_a_page_follows_what_happens_and_keeps_the_focus(browser, address, submit, finish, end_jobs):
    job = submit(2)
    browser.open(f"{address}/dashboard")
    browser.wait_for(says("0 of 2 segments"))
    tab_to(browser, f"job-{job}")
    assert browser.ask("document.activeElement.matches(':focus-visible')")
    browser.ask("window.isTheSamePage = true")
    finish()
    browser.wait_for(says("1 of 2 segments"))
    browser.wait_for(f"document.activeElement.id === 'job-{job}'")
    finish("FAILED")
    browser.wait_for(says("The segment cannot be read"))
    spoken = "document.getElementById('announcement').textContent"
    browser.wait_for(f"{spoken}.startsWith('0 waiting, 0 running, 1 failed')")
    assert browser.ask("window.isTheSamePage")
    assert browser.complaints == []


def test_what_did_not_change_is_not_touched(browser, address, submit):
    job = submit()
    browser.open(f"{address}/dashboard/jobs/{job}")
    browser.ask(
        "window.numPolls = window.numChanges = 0;"
        "document.addEventListener('htmx:afterRequest', () => { window.numPolls += 1 });"
        "new MutationObserver((all) => { window.numChanges += all.length })"
        ".observe(document.body, {childList: true, characterData: true, subtree: true})"
    )
    browser.wait_for("window.numPolls >= 2")
    assert browser.ask("window.numChanges") == 0


def test_jobs_are_cancelled_and_retried_with_keys_alone(browser, address, submit):
    job = submit()
    browser.open(f"{address}/dashboard/jobs/{job}")
    tab_to(browser, "cancel")
    browser.press(*ENTER)
    browser.wait_for(says("CANCELLED"))
    assert browser.questions == ["Cancel this job? What is labelled already stays."]
    tab_to(browser, "retry")
    browser.press(*ENTER)
    browser.wait_for(says("QUEUED") + " && " + says("Cancel the job"))
    assert len(browser.questions) == 1
    assert browser.complaints == []


def test_the_first_tab_leads_past_the_header(browser, address):
    browser.open(f"{address}/dashboard")
    browser.press(*TAB)
    assert browser.ask("document.activeElement.textContent") == "Skip to the content"
    browser.press(*ENTER)
    browser.wait_for("document.activeElement.id === 'main'")


def test_a_name_is_no_script_and_the_policy_holds(browser, address, submit):
    job = submit(segments=["/data/<script>window.isBroken = true</script><img src=x onerror='window.isBroken = true'>"])
    browser.open(f"{address}/dashboard/jobs/{job}")
    browser.wait_for(says("<script>window.isBroken = true</script>"))
    assert browser.complaints == []
    browser.ask(
        "document.body.insertAdjacentHTML('beforeend', \"<i style='color: red' onclick='window.isBroken = 1'>\")"
    )
    browser.ask("document.querySelector('i').click()")
    browser.wait_for("true")
    assert len([text for text in browser.complaints if "Content Security Policy" in text]) == 2
    assert not browser.ask("window.isBroken === true || window.isBroken === 1")


def test_a_page_that_cannot_be_refreshed_says_so_until_it_can(browser, address, submit, monkeypatch):
    submit()
    browser.open(f"{address}/dashboard")
    is_hidden = "document.getElementById('stale').hidden"
    assert browser.ask(is_hidden)

    def fail(_):
        raise OperationalError("", {}, Exception("database is locked"))

    with monkeypatch.context() as patch:
        patch.setattr(JobStore, "status", fail)
        browser.wait_for(f"!{is_hidden} && {says('What it shows may be old')} && {says('0 of 1 segment')}")
    browser.wait_for(is_hidden)


def test_nothing_is_asked_while_updates_are_off(browser, address, submit):
    job = submit()
    browser.open(f"{address}/dashboard/jobs/{job}")
    browser.ask(
        "window.numAsked = window.numDue = 0;"
        "document.addEventListener('htmx:confirm', () => { window.numDue += 1 });"
        "document.addEventListener('htmx:afterRequest', () => { window.numAsked += 1 })"
    )
    browser.wait_for("window.numAsked >= 1")
    browser.ask("document.getElementById('is-live').click(); window.numAsked = window.numDue = 0")
    browser.wait_for("window.numDue >= 2")
    assert browser.ask("window.numAsked") <= 1  # one may have been under way
    browser.ask("document.getElementById('is-live').click()")
    browser.wait_for("window.numAsked >= 2")


@pytest.mark.parametrize("num_jobs", [0, 3])
def test_pages_fit_a_phone(browser, address, submit, finish, num_jobs):
    jobs = [submit(segments=[f"/data/{'long' * 40}/{number}"], output_uri="/out" * 40) for number in range(num_jobs)]
    if jobs:
        finish("FAILED")
    browser.resize(360, 740)
    for path in ("/dashboard", "/dashboard/nothing", *(f"/dashboard/jobs/{job}" for job in jobs[:1])):
        browser.open(f"{address}{path}")
        assert browser.ask("document.documentElement.scrollWidth") == 360
        assert browser.ask("[...document.querySelectorAll('.filters a, button')].every((e) => e.offsetHeight >= 24)")


def test_people_sign_in_and_out_with_the_keyboard_and_a_revoked_key_is_asked_for_anew(
    browser, keyed_address, issue, keyed
):
    token = issue("ann")
    browser.open(f"{keyed_address}/dashboard")
    for wrong in ("x", token):
        tab_to(browser, "key")
        browser.ask(f"document.getElementById('key').value = {json.dumps(wrong)}")
        browser.press(*ENTER)
        browser.wait_for(says("This is no key" if wrong == "x" else "Signed in as ann"))
    assert browser.ask("location.pathname") == "/dashboard"
    assert browser.ask("document.cookie") == ""
    tab_to(browser, "sign-out")
    browser.press(*ENTER)
    browser.wait_for("document.getElementById('key') !== null")
    browser.ask(f"document.getElementById('key').value = {json.dumps(token)}; document.forms[0].requestSubmit()")
    browser.wait_for(says("Signed in as ann"))
    revoke_key(keyed.api_keys_file, token[3:11])
    browser.wait_for("document.getElementById('key') !== null")  # by the next poll
    assert [complaint for complaint in browser.complaints if "401" not in complaint] == []
