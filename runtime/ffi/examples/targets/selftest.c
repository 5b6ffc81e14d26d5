/* Runs the self-test of the image that is linked in, then an episode of its own, and prints a hash of all bits of the actions:
 * the same on every target. Hosted, or bare on Cortex-M with semihosting (startup.c). */
#include <lads.h>

#ifndef IMAGE
#define IMAGE policy_image
#endif
#ifndef WORKSPACE_BYTES
#define WORKSPACE_BYTES (64 * 1024)
#endif
enum { OBSERVATION_MOST = 64, ACTION_MOST = 16, STEPS = 40 };

extern const unsigned char IMAGE[IMAGE_BYTES];
void say(const char *text);

static lads_policy policy;
static _Alignas(LADS_WORKSPACE_ALIGN) unsigned char workspace[WORKSPACE_BYTES];

static void say_hash(uint32_t hash) {
    char text[] = "actions 00000000\n";
    for (int digit = 0; digit < 8; digit++) {
        text[15 - digit] = "0123456789abcdef"[hash >> 4 * digit & 15];
    }
    say(text);
}

int run(void) {
    lads_contract contract;
    lads_element element;
    lads_controller *controller;
    float observation[OBSERVATION_MOST], action[ACTION_MOST];
    lads_status status = lads_policy_open(IMAGE, IMAGE_BYTES, &policy);
    if (status == LADS_STATUS_OK) {
        status = lads_controller_init(&policy, workspace, sizeof workspace, NULL, &controller);
    }
    if (status == LADS_STATUS_OK) {
        status = lads_self_test(controller, NULL);
    }
    if (status == LADS_STATUS_OK) {
        status = lads_set_instruction(controller, 0);
    }
    if (status == LADS_STATUS_OK) {
        status = lads_policy_contract(&policy, &contract);
    }
    if (status != LADS_STATUS_OK || contract.observation_len > OBSERVATION_MOST || contract.action_len > ACTION_MOST) {
        say(lads_status_text(status));
        say("\n");
        return 1;
    }
    say("self-test passed\n");
    uint32_t hash = 2166136261u, random = 1;
    for (int step = 0; step < STEPS; step++) {
        for (size_t i = 0; i < contract.observation_len; i++) {
            lads_policy_observation(&policy, i, &element);
            random = random * 1664525u + 1013904223u;
            const float share = (float)(random >> 16) / 65536.0f;
            const float width = element.max - element.min;
            const float part = width * share;
            observation[i] = element.min + part;
        }
        status = lads_step(controller, observation, contract.observation_len, NULL, action, contract.action_len, NULL);
        if (status != LADS_STATUS_OK) {
            say(lads_status_text(status));
            say("\n");
            return 2;
        }
        for (size_t i = 0; i < contract.action_len; i++) {
            union { float value; uint32_t bits; } word = {.value = action[i]};
            hash = (hash ^ word.bits) * 16777619u;
        }
    }
    say_hash(hash);
    return 0;
}

#if !defined(__arm__)
#include <stdio.h>
void say(const char *text) { fputs(text, stdout); }
int main(void) { return run(); }
#endif
